from typing import Any

import numpy as np
import pytest

from aero_planner import Planner
from tests.planner import reference
from tests.planner.cases import config_of, exact, random_case

SEEDS = range(4)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", SEEDS)
def test_initial_endpoints(device: str, preset: str, seed: int):
    config, case = config_of(preset), random_case(seed)
    plan = case.plan(Planner(config, device=device))
    directions = reference.anchor_directions(case.position, case.velocity, case.goal, config)
    distance = float(np.linalg.norm(case.goal - case.position))
    expected = case.position + reference.lookahead(distance, config) * directions
    # float32 resolves 2e-6 m at 30 m, and turns 5 m by 1e-6 rad.
    np.testing.assert_allclose(plan.initial_endpoints[:15], expected, atol=3e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_anchors_are_the_safe_directions_of_their_cells(device: str, seed: int):
    config, case = config_of("paper"), random_case(seed, count=400)
    plan = case.plan(Planner(config, device=device))
    R = reference.rotation(reference.unit(case.quaternion))
    directions = reference.anchor_directions(case.position, case.velocity, case.goal, config) @ R
    rows, columns, border = reference.cell_indices(directions, 10, 20)
    places = zip(plan.kinds, plan.anchors, directions, rows, columns, border, strict=True)
    for kind, anchor, toward, row, column, margin in places:
        if kind == "brake" or margin < 1e-4:
            continue  # replaced since no candidate was safe, or seen in the neighbouring cell by float32
        _, tied = reference.safe_cells(plan.fine_range, 6, row, column)
        chosen = (anchor - case.position) @ R / 5.0
        # 3e-5 m of rounding at 5 m; the kernel calls cosines within 1e-6 equal.
        assert np.abs(tied - chosen).max(axis=1).min() < 1e-5
        assert chosen @ toward >= (tied @ toward).max() - 1e-5


def test_in_open_space_anchors_stay_within_half_a_fine_cell(device: str):
    case = random_case(1, count=0)
    plan = case.plan(Planner(config_of("paper"), device=device))
    turned = np.linalg.norm(plan.anchors - plan.initial_endpoints, axis=1) / 5.0
    # The farthest corner of a 3 deg cell is sqrt(2) 1.5 deg off its centre; 3 deg where a cell's border is near.
    assert turned.max() < np.radians(3.0)


@pytest.mark.parametrize("speed", [0.0, 2.0, 6.5, 12.0])
@pytest.mark.parametrize("distance", [0.3, 2.0, 40.0])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"vehicle__speed_limit": 3.0},
        {"anchors__lookahead": 12.0, "vehicle__speed_limit": 50.0},
        {"sampling__dt": 0.02, "anchors__lookahead_time": 1.0},
    ],
)
def test_lookahead(device: str, speed: float, distance: float, changes: dict[str, Any]):
    config, case = config_of(**changes), random_case(0, count=0)
    case.velocity = exact([speed, 0, 0])
    case.goal = case.beside(0, distance, 0)
    planner = Planner(config, device=device)
    case.plan(planner)
    expected = reference.lookahead(float(np.linalg.norm(case.goal - case.position)), config)
    for endpoints in (planner.outputs.initial_endpoints, planner.outputs.anchors):
        reached = np.linalg.norm(endpoints.numpy()[0, :15] - case.position, axis=1)
        np.testing.assert_allclose(reached, expected, atol=2e-5)


def test_a_goal_at_the_drone_holds_its_position(device: str):
    case = random_case(3, speed=0.0, count=0, tilt=0.0)
    case.goal = case.position
    case.acceleration = np.zeros(3)
    still: dict[str, Any] = {f"sampling__variance_{name}": 0.0 for name in ("thrust", "rate_xy", "rate_z")}
    plan = case.plan(Planner(config_of(**still), device=device))
    np.testing.assert_allclose(plan.initial_endpoints, case.position[None].repeat(16, 0), atol=1e-5)
    np.testing.assert_allclose(plan.anchors, plan.initial_endpoints, atol=1e-5)
    assert all(np.isfinite(array).all() for array in (plan.guides, plan.controls, plan.stage1_cost, plan.positions))
    # A drone at rest at its goal stays there, but for what is sampled.
    assert np.linalg.norm(plan.positions[plan.best] - case.position, axis=1).max() < 1e-3


def test_a_near_goal_is_the_middle_anchor(device: str):
    case = random_case(2, count=0)
    case.goal = case.beside(0.5, 0.6, 0.2)
    plan = case.plan(Planner(config_of("paper"), device=device))
    np.testing.assert_allclose(plan.initial_endpoints[7], case.goal, atol=1e-5)
