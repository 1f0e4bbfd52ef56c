"""Clouds that the caller writes to `Planner.points`."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from aero_planner import Goal, Planner, VehicleState
from tests.planner.cases import batch_of, config_of, random_case


def write_points(planner: Planner[Any], points: ArrayLike, first: int = 0) -> None:
    """Write points [n, 3], or [B, n, 3] for a batch, to the cloud on the device from row `first` on."""
    clouds = np.asarray(points, dtype=np.float32)
    for b, cloud in enumerate(clouds.reshape(-1, *clouds.shape[-2:])):
        row = planner.points[b]
        assert isinstance(row, wp.array)
        wp.copy(row, wp.array(cloud, dtype=wp.vec3, device=planner.device), dest_offset=first, count=len(cloud))


def test_sweeps_written_one_after_another_are_the_cloud(device: str):
    config, case = config_of(), random_case(0)
    whole = case.plan(Planner(config, device=device))
    planner = Planner(config, device=device)
    planner.reserve(len(case.points))
    for first in range(0, len(case.points), 500):
        write_points(planner, case.points[first : first + 500], first)
    plan = planner.plan(case.state, Goal(case.goal), planner.points)
    np.testing.assert_array_equal(plan.controls, whole.controls)
    np.testing.assert_array_equal(plan.fine_range, whole.fine_range)


def test_every_drone_of_a_batch_has_its_own_points(device: str):
    config, cases = config_of(), [random_case(seed) for seed in (1, 2)]
    planner = Planner(config, device=device, batch=2)
    count = min(len(case.points) for case in cases)
    planner.reserve(count)
    write_points(planner, np.stack([case.points[:count] for case in cases]))
    state, goal, _ = batch_of(cases)
    plan = planner.plan(state, goal, planner.points)
    for b, case in enumerate(cases):
        case.points = case.points[:count]
        alone = case.plan(Planner(config, device=device, seed=b))
        np.testing.assert_array_equal(plan.fine_range[b], alone.fine_range)


def test_the_next_plan_sees_overwritten_points(device: str):
    planner = Planner(config_of(partition__view_age=0.0), device=device)
    planner.reserve(2)
    state, goal = VehicleState([0, 0, 2], [0, 0, 0], [1, 0, 0, 0]), Goal([30, 0, 2])
    write_points(planner, [[5.0, 0, 2], [0, 4.0, 2]])
    before = planner.plan(state, goal, planner.points)
    write_points(planner, [[3.0, 0, 2]], first=0)
    after = planner.plan(state, goal, planner.points)
    clouds = [np.asarray(plan.filtered_points) for plan in (before, after)]
    ranges = [np.sort(np.linalg.norm(cloud - [0, 0, 2], axis=1)) for cloud in clouds]
    np.testing.assert_allclose(ranges, [[4.0, 5.0], [3.0, 4.0]])


def test_points_passed_to_plan_replace_the_cloud(device: str):
    planner = Planner(config_of(), device=device)
    planner.reserve(1)
    write_points(planner, [[3.0, 0, 2]])
    state = VehicleState([0, 0, 2], [0, 0, 0], [1, 0, 0, 0])
    plan = planner.plan(state, Goal([30, 0, 2]), np.array([[6.0, 0, 2]]))
    np.testing.assert_array_equal(plan.filtered_points, [[6.0, 0, 2]])
