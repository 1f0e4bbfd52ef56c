"""Continued surfaces: what is added, and the attitude for which the field of view holds."""

import dataclasses

import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, PlannerConfig, VehicleState
from tests.planner import reference
from tests.planner.cases import PERIOD, Case, config_of, kept_points, level_case, random_case


@pytest.mark.parametrize("depth", [0.0, 1.0, 2.0])
def test_a_wall_continues_below_the_field_of_view(device: str, depth: float):
    """The points that are added lie on the wall, below its seen part and at most `depth` deeper."""
    case, edge = level_case(), -4.0 * np.tan(np.radians(7.0))
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(edge, 2, 0.05))
    case.points = np.stack((np.full_like(y, 4.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    plan = case.plan(Planner(config_of(unseen_space__continuation=depth), device=device))
    kept = kept_points(plan).astype(np.float64)
    added = kept[kept[:, 2] < edge - 0.1]
    assert (len(added) > 0) == (depth > 0.0)
    if depth > 0.0:
        # A neighbouring column of cells may hold the source: 3 deg at 4 m change x by at most 0.1 m.
        np.testing.assert_allclose(added[:, 0], 4.0, atol=0.15)
        assert added[:, 2].min() > edge - depth - 0.1 and added[:, 2].min() < edge - 0.7 * depth


@pytest.mark.parametrize("height", [0.0, 1.0, 2.0])
def test_a_wall_continues_above_the_field_of_view(device: str, height: float):
    """The points that are added lie on the wall, above its seen part and at most `height` higher."""
    case, edge = level_case(), 2.0 * np.tan(np.radians(52.0))
    y, z = np.meshgrid(np.arange(-1, 1, 0.03), np.arange(-0.2, edge, 0.03))
    case.points = np.stack((np.full_like(y, 2.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    config = config_of(unseen_space__continuation=height)
    kept = kept_points(case.plan(Planner(config, device=device))).astype(np.float64)
    added = kept[kept[:, 2] > edge + 0.1]
    assert (len(added) > 0) == (height > 0.0)
    if height > 0.0:
        np.testing.assert_allclose(added[:, 0], 2.0, atol=0.15)
        assert added[:, 2].max() < edge + height + 0.1 and added[:, 2].max() > edge + 0.5 * height


@pytest.mark.parametrize("continuation", [2.0, 20.0])
def test_continued_cells_are_those_of_the_rule(device: str, continuation: float):
    """The drone has turned since the plan before; rounding may decide for a few of the cells."""
    config = config_of(unseen_space__continuation=continuation)
    without = config.replace({"unseen_space.continuation": 0.0})
    planner, filled, different = Planner(config, device=device), 0, 0
    for seed in range(3):
        case = random_case(seed, count=3000, tilt=0.4)
        measured = case.plan(Planner(without, device=device))
        turned = dataclasses.replace(case, quaternion=random_case(seed + 100, tilt=0.4).quaternion)
        planner.reset()
        turned.plan(planner)
        found = case.plan(planner).fine_range.ravel()
        expected = continued_ranges(case, config, measured, turned.quaternion)
        filled += np.sum(expected != measured.fine_range.ravel())
        different += np.sum(np.abs(found - expected) > 1e-3)
    assert filled > 300 and different <= 0.02 * filled


def continued_ranges(case: Case, config: PlannerConfig, measured: Plan, before: np.ndarray) -> np.ndarray:
    """Return the fine ranges [m] with continued surfaces, shape [F].

    `measured` is a plan without them, and `before` the attitude at the plan before, which was the first one.
    """
    space, R, ranges = config.unseen_space, reference.rotation(reference.unit(case.quaternion)), measured.fine_range
    view = space.views[0]
    rows, columns = ranges.shape
    elevation = np.repeat((np.arange(rows) + 0.5) * np.pi / rows - np.pi / 2, columns)
    azimuth = np.tile((np.arange(columns) + 0.5) * 2 * np.pi / columns - np.pi, rows)
    directions = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))

    def cells_of(d: np.ndarray) -> np.ndarray:
        row = np.floor((np.arctan2(d[2], np.hypot(d[0], d[1])) / np.pi + 0.5) * rows).astype(int)
        column = np.floor((np.arctan2(d[1], d[0]) / (2 * np.pi) + 0.5) * columns).astype(int) % columns
        return np.clip(row, 0, rows - 1) * columns + column

    q, before = reference.unit(case.quaternion), reference.unit(before)
    share = PERIOD / (PERIOD + space.view_age)
    seen_from = reference.rotation(reference.unit((1.0 - share) * before * np.sign(before @ q) + share * q))
    offsets = np.full((3, rows * columns), np.inf)
    offsets[:, ranges.ravel() < config.farthest_range] = (
        np.asarray(measured.filtered_points, dtype=float) - case.position
    ).T
    result = ranges.ravel().astype(float)
    lower, upper = elevation - np.radians(view.lowest), np.radians(view.highest) - elevation
    world = R @ directions
    flat = np.hypot(world[0], world[1])
    for side in (0, 1):
        source = cells_of(R.T @ directions)
        x = offsets[:, source]
        has_point = np.isfinite(x[0])
        x[:, ~has_point] = 1.0
        earlier = seen_from.T @ (x + space.view_age * case.velocity[:, None])
        angle = np.arctan2(earlier[2], np.hypot(earlier[0], earlier[1]))
        then = angle - np.radians(view.lowest) if side == 0 else np.radians(view.highest) - angle
        is_edge = np.minimum((lower, upper)[side][source], then) <= 2 * np.pi / rows
        away = np.where(has_point & is_edge, np.hypot(x[0], x[1]), np.inf).reshape(rows, columns)
        height = x[2].reshape(rows, columns)
        order = range(rows - 1, -1, -1) if side == 0 else range(rows)
        nearest, level = np.full(columns, np.inf), np.zeros(columns)
        for row in order:
            is_nearer = away[row] < nearest + 0.1
            nearest, level = np.where(is_nearer, away[row], nearest), np.where(is_nearer, height[row], level)
            away[row], height[row] = nearest, level
        place = cells_of(world)
        distance = away.ravel()[place] / np.maximum(flat, 0.2)
        depth = (height.ravel()[place] - distance * world[2]) * (1 if side == 0 else -1)
        is_filled = (lower <= upper if side == 0 else upper < lower) & (flat >= 0.2) & (depth <= space.continuation)
        is_filled &= (distance <= config.farthest_range) & (ranges.ravel() == config.farthest_range)
        result[is_filled] = distance[is_filled]
    return result


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_the_attitude_of_the_view_is_the_given_one_of_some_time_ago(device: str, period: float):
    """Recorded drones do not follow the commands of the planner: what counts is how they turned."""
    config, rate = config_of(unseen_space__view_age=0.1), 1.0
    planner, case = Planner(config, device=device), level_case()
    for tick in range(round(1.0 / period) + 1):
        half = 0.5 * rate * tick * period
        attitude = np.array([np.cos(half), 0.0, np.sin(half), 0.0]) * (-1.0) ** tick  # q and -q are the same attitude
        state = VehicleState(case.position, case.velocity, attitude, case.acceleration, time=tick * period)
        planner.plan(state, Goal(case.goal), case.points)
    w, _, y, _ = planner.history().arrays["view_quaternion"][0]
    assert 2.0 * np.arctan2(y, w) % (2.0 * np.pi) == pytest.approx(rate * (1.0 - 0.1), abs=1e-3)
    planner.reset()
    case.plan(planner)
    np.testing.assert_array_equal(planner.history().arrays["view_quaternion"][0], case.quaternion)


def test_a_wall_that_has_just_come_into_view_continues(device: str):
    """A descending drone has its lower edge of view below what the newest sweep saw."""
    case, edge = level_case(), -0.2
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(edge, 2, 0.05))
    case.points = np.stack((np.full_like(y, 3.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    case.points += [0.0, 0.0, 0.7]  # the drone has sunk by 0.7 m since

    def lowest(age: float = 0.1) -> float:
        config = config_of(unseen_space__view_age=age)
        kept = kept_points(case.plan(Planner(config, device=device)))
        return float(kept[np.abs(kept[:, 1]) < 1.0, 2].min())

    assert lowest() > edge + 0.65  # at rest, what is in view was seen
    case.velocity = np.array([0.0, 0.0, -7.0])
    assert lowest() < -4.0
    assert lowest(age=0.0) > edge + 0.65
