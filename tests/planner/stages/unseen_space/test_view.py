"""Space beside the field of view is unknown."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.quaternions import quaternion_from_angles
from aero_planner.stages.unseen_space.continuation import UNKNOWN_RANGE
from tests.planner import reference
from tests.planner.cases import PERIOD, Case, assert_same, config_of, level_case, random_case

VIEWS = {
    "forward": "-7 52 87",
    "to the left": "-7 52 60 150",
    "forward and back": "-7 52 87; -7 52 120 180",
}
UNKNOWN = float(UNKNOWN_RANGE)
SLOW: dict[str, Any] = {"way_out__spread": 1.0}
"""Anchors have their usual spacing although the drone is slow."""


def is_beside(config: PlannerConfig, case: Case, before: np.ndarray) -> np.ndarray:
    """Return True for fine cells beside the view, and NaN for those whose centre is at its edge, shape [F].

    `before` is the attitude at the plan before, which was the first one.
    """
    space, (rows, columns) = config.unseen_space, config.fine_shape
    elevation = np.repeat((np.arange(rows) + 0.5) * np.pi / rows - np.pi / 2, columns)
    azimuth = np.tile((np.arange(columns) + 0.5) * 2 * np.pi / columns - np.pi, rows)
    d = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
    q, before = reference.unit(case.quaternion), reference.unit(before)
    share = PERIOD / (PERIOD + space.view_age)
    then = reference.rotation(reference.unit((1.0 - share) * before * np.sign(before @ q) + share * q))
    world = reference.rotation(q) @ d
    seen = then.T @ world
    angle = np.degrees(np.arctan2(seen[1], seen[0]))
    beside = np.ones(rows * columns)
    for _, _, width, middle in space.views:
        off = np.abs((angle - middle + 180.0) % 360.0 - 180.0) - width / 2
        beside[off < 0.0] = 0.0
        beside[np.abs(off) < 1e-3] = np.nan
    beside[np.hypot(world[0], world[1]) < 0.2] = 0.0  # straight up and down
    return beside


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_cells_beside_the_view_end_where_unknown_space_begins(device: str, view: str):
    """The drone has turned since the plan before: what has come into view since is not known yet."""
    config, all_around = config_of(unseen_space__view=view), config_of()
    for seed in range(3):
        case = random_case(seed, count=2000, tilt=0.4)
        turned = dataclasses.replace(case, quaternion=random_case(seed + 100, tilt=0.4).quaternion)
        plans = []
        for variant in (config, all_around):
            planner = Planner(variant, device=device)
            turned.plan(planner)
            plans.append(case.plan(planner))
        beside = is_beside(config, case, turned.quaternion)
        found, open_range = plans[0].fine_range.ravel(), plans[1].fine_range.ravel()
        is_measured = (open_range < config.farthest_range) & ~plans[1].continued_cells.ravel()
        blocked = np.minimum(open_range, UNKNOWN)
        expected = np.where((beside == 1.0) & ~is_measured, blocked, open_range)
        compared = ~np.isnan(beside)
        np.testing.assert_allclose(found[compared], expected[compared], atol=1e-4)
        assert 500 < np.sum(found < open_range) < np.sum(plans[0].continued_cells)


def test_unknown_space_is_avoided_like_a_surface(device: str):
    """In the open, the goal lies beside the view: no way to it is clear until the drone has turned to it."""
    case = level_case()
    case.points = np.full((1, 3), 1e3, np.float32)
    case.velocity = np.zeros(3)
    case.goal = case.beside(0.0, 20.0, 0.0)
    free = case.plan(Planner(config_of(**SLOW), device=device))
    narrow = case.plan(Planner(config_of(unseen_space__view="-7 52 60", sampling__samples=64, **SLOW), device=device))
    assert free.collision_cost[:15].max() == 0.0
    x, y, _ = np.moveaxis(
        narrow.positions[:15][narrow.collision_cost[:15] < config_of().costs.penalty] - case.position, 2, 0
    )
    is_far = np.hypot(x, y) > UNKNOWN
    assert x.size > 0 and (np.degrees(np.abs(np.arctan2(y, x)))[is_far] < 30.0).all()
    assert narrow.controls[narrow.best, :5, 3].mean() > 1.0, "turns to the left"


def test_a_candidate_turns_to_where_it_flies(device: str):
    """Without noise of the yaw rate it is that of the guide: the angle to its endpoint is turned in 0.4 s."""
    case = level_case()
    case.points = np.full((1, 3), 1e3, np.float32)
    case.quaternion = quaternion_from_angles(0.0, 0.0, 25.0)
    plan = case.plan(
        Planner(config_of(sampling__variance_rate_z=0.0, unseen_space__view="-7 52 200", **SLOW), device=device)
    )
    offset = plan.anchors[:15] - case.position
    turn = np.arctan2(offset[:, 1], offset[:, 0]) - np.radians(25.0)
    np.testing.assert_allclose(plan.controls[:15, 0, 3], np.clip(turn / 0.4, -2.0, 2.0), atol=1e-3)


def test_views_all_around_leave_every_plan_as_it_is(device: str):
    """The second view adds nothing to the first one."""
    case = random_case(4, count=3000, tilt=0.4)
    once, twice = (
        case.plan(Planner(config_of(unseen_space__view=view), device=device))
        for view in ("-7 52", "-7 52 360 90; -7 52 30 10")
    )
    assert_same(once, twice)
