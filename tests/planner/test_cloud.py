"""Points that are copied beside a plan."""

from __future__ import annotations

import numpy as np
import pytest

from aero_planner import Goal, Planner, VehicleState
from tests.planner.cases import config_of, random_case


def test_uploaded_sweeps_are_the_cloud(device: str):
    config, case = config_of(), random_case(0)
    whole = case.plan(Planner(config, device=device))
    planner = Planner(config, device=device)
    planner.reserve(len(case.points))
    for first in range(0, len(case.points), 500):
        planner.upload(case.points[first : first + 500], first=first)
    plan = planner.plan(case.state, Goal(case.goal), planner.points)
    np.testing.assert_array_equal(plan.controls, whole.controls)
    np.testing.assert_array_equal(plan.fine_range, whole.fine_range)


def test_a_batch_uploads_for_every_drone(device: str):
    config, cases = config_of(), [random_case(seed) for seed in (1, 2)]
    planner = Planner(config, device=device, batch=2)
    count = min(len(case.points) for case in cases)
    planner.reserve(count)
    planner.upload(np.stack([case.points[:count] for case in cases]))
    state = VehicleState(*(np.stack([getattr(case, name) for case in cases]) for name in
                           ("position", "velocity", "quaternion")))  # fmt: skip
    plan = planner.plan(state, Goal(np.stack([case.goal for case in cases])), planner.points)
    for b, case in enumerate(cases):
        case.points = case.points[:count]
        alone = case.plan(Planner(config, device=device, seed=b))
        np.testing.assert_array_equal(plan.fine_range[b], alone.fine_range)


def test_a_later_upload_replaces_its_part_and_the_next_plan_sees_it(device: str):
    planner = Planner(config_of(), device=device)
    planner.reserve(2)
    state, goal = VehicleState([0, 0, 2], [0, 0, 0], [1, 0, 0, 0]), Goal([30, 0, 2])
    planner.upload([[5.0, 0, 2], [0, 4.0, 2]])
    before = planner.plan(state, goal, planner.points)
    planner.upload([[3.0, 0, 2]], first=0)
    after = planner.plan(state, goal, planner.points)
    clouds = [np.asarray(plan.filtered_points) for plan in (before, after)]
    ranges = [np.sort(np.linalg.norm(cloud - [0, 0, 2], axis=1)) for cloud in clouds]
    np.testing.assert_allclose(ranges, [[4.0, 5.0], [3.0, 4.0]])


def test_a_plan_with_points_forgets_what_was_sent(device: str):
    planner = Planner(config_of(), device=device)
    planner.reserve(1)
    planner.upload([[3.0, 0, 2]])
    state = VehicleState([0, 0, 2], [0, 0, 0], [1, 0, 0, 0])
    plan = planner.plan(state, Goal([30, 0, 2]), np.array([[6.0, 0, 2]]))
    np.testing.assert_array_equal(plan.filtered_points, [[6.0, 0, 2]])


@pytest.mark.parametrize(
    ("points", "first", "message"),
    [
        (np.zeros((3, 2)), 0, r"shape \(3, 2\).*shape \(n, 3\)"),
        (np.zeros((1, 3, 3)), 0, r"shape \(1, 3, 3\)"),
        (np.array([["a", "b", "c"]]), 0, "numbers"),
        (np.zeros((6, 3)), 0, "room for 5 points, not for those from 0 to 6; call reserve"),
        (np.zeros((2, 3)), 4, "from 4 to 6"),
        (np.zeros((2, 3)), -1, "from -1 to 1"),
    ],
)
def test_what_does_not_fit_is_refused(device: str, points: np.ndarray, first: int, message: str):
    planner = Planner(config_of(), device=device)
    planner.reserve(5)
    with pytest.raises(ValueError, match=message):
        planner.upload(points, first=first)
