"""Which points of a sweep are stray, against a count of neighbours in NumPy."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner import Goal, Plan, Planner, Sweeps, VehicleState
from aero_planner.sweeps import Arrival
from tests.planner.stages.sequence import config_with

Array = NDArray[Any]
VOXEL, SIDE, NEAR, FAR, SUPPORT, NOW, SWEEPS = 0.04, 64, 1.25, 2.0, 26, 8, 20


def rain(rng: np.random.Generator, count: int, place: Array) -> Array:
    """Return points in the air within a metre, [count, 3]."""
    directions = rng.normal(size=(count, 3))
    ranges = rng.uniform(0.1**3, 1.0, count) ** (1.0 / 3.0)
    return place + ranges[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None]


def wire(rng: np.random.Generator, count: int) -> Array:
    """Return points of a wire of 8 mm radius along y, 0.9 m ahead of the origin, [count, 3]."""
    return np.column_stack(
        (0.9 + rng.normal(0.0, 0.01, count), rng.uniform(-1.0, 1.0, count), rng.uniform(-0.008, 0.008, count))
    )


def sweep(*parts: Array) -> Array:
    """Return the parts as one sweep."""
    return np.concatenate(parts).astype(np.float32)


def plan_of(planner: Planner, sweeps: list[Array], positions: Array) -> Plan:
    """Return the plan at the last position, of sweeps that were complete at the positions, one after another."""
    memory, plan = Sweeps(), None
    for i, (points, position) in enumerate(zip(sweeps, positions, strict=True)):
        memory = memory.add(points, limit=30, arrival=Arrival(0.1 * i, tuple(position)))
        state = VehicleState(position, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), None, 0.1 * i)
        plan = planner.plan(state, Goal((20.0, 0.0, 0.0)), memory)
    assert plan is not None
    return plan


def expected(sweeps: list[Array], positions: Array) -> Array:
    """Return the points that are kept of all sweeps, [n, 3]."""
    kept = []
    middles = [positions[0], *(0.5 * (before + after) for before, after in pairwise(positions))]
    lists: list[Array] = []
    far = [np.zeros((0, 3))]
    for points, middle, position in zip(sweeps, middles, positions, strict=True):
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        distance = np.linalg.norm(points - middle, axis=1)
        near = distance < NEAR
        lists.append(points[distance < FAR])
        grid = np.zeros((2, *(SIDE + 2,) * 3), int)
        for k, supporting, support in ((0, lists[-SWEEPS:], 1), (0, far, SUPPORT), (1, lists[-1:], 1)):
            voxels = np.floor((np.concatenate(supporting) - middle) / VOXEL + SIDE / 2).astype(int)
            inside = ((voxels >= 0) & (voxels < SIDE)).all(axis=1)
            np.add.at(grid[k], tuple(voxels[inside].T + 1), support)
        far.append(points[np.linalg.norm(points - position, axis=1) > FAR])
        own = np.floor((points - middle) / VOXEL + SIDE / 2).astype(int) + 1
        for point, voxel, is_near in zip(points, own, near, strict=True):
            x, y, z = voxel
            found, found_now = grid[:, x - 1 : x + 2, y - 1 : y + 2, z - 1 : z + 2].sum(axis=(1, 2, 3))
            if not is_near or found >= SUPPORT or found_now >= NOW:
                kept.append(point)
    return np.array(kept).reshape(-1, 3)


@pytest.fixture
def planner(device: str) -> Planner:
    return Planner(config_with(("stray_points",)), device=device)


def filtered(plan: Plan) -> Array:
    return np.asarray(plan.filtered_points, dtype=np.float64)


def distance_to(points: Array, others: Array) -> Array:
    """Return the distance of each point to the nearest of others [m], infinite without others."""
    return np.linalg.norm(points[:, None] - others[None], axis=-1).min(axis=1, initial=np.inf)


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_the_points_that_remain_have_enough_neighbours(planner: Planner, speed: float):
    rng = np.random.default_rng(3)
    positions = np.column_stack((0.1 * speed * np.arange(-23, 1), np.zeros((24, 2))))
    sweeps = [sweep(rain(rng, 500, place), wire(rng, 60)) for place in positions]
    kept = expected(sweeps, positions)
    shown = filtered(plan_of(planner, sweeps, positions))
    # Each cell shows its nearest point. Rounding may decide at the border of a voxel.
    assert len(shown) > 20 and (distance_to(shown, kept) < 1e-4).mean() > 0.97


def test_rain_is_removed_and_a_wire_stays(planner: Planner):
    rng = np.random.default_rng(4)
    positions = np.column_stack((0.3 * np.arange(14) - 3.9, np.zeros((14, 2))))  # the wire comes near
    sweeps = [sweep(rain(rng, 500, place), wire(rng, 60)) for place in positions]
    shown = filtered(plan_of(planner, sweeps, positions))
    is_wire = np.linalg.norm(shown[:, [0, 2]] - [0.9, 0.0], axis=1) < 0.06
    assert is_wire.sum() > 25 and (~is_wire).sum() <= 3
    assert np.diff(np.sort(shown[is_wire, 1])).max() < 0.25, "the wire has no gap that a drone fits through"


def test_what_was_measured_from_afar_is_kept_however_few_points_it_has(planner: Planner):
    rng = np.random.default_rng(8)
    twig = np.array([[0.9, 0.02 * i, 0.0] for i in range(3)])
    approach = np.column_stack((np.arange(-4.0, 0.1, 0.5), np.zeros((9, 2))))
    for seen_from_afar in (True, False):
        planner.reset()
        sweeps = [sweep(rain(rng, 50, place), *([twig] if seen_from_afar else [])) for place in approach[:-1]]
        shown = filtered(plan_of(planner, [*sweeps, sweep(twig)], approach))
        sweeps_of_twig = distance_to(twig, shown) if len(shown) else np.full(3, np.inf)
        assert (sweeps_of_twig.min() < 0.05) == seen_from_afar


def test_a_wire_that_was_never_seen_from_afar_appears_soon(planner: Planner):
    rng = np.random.default_rng(5)
    positions = np.zeros((12, 3))
    shown = filtered(plan_of(planner, [sweep(wire(rng, 50)) for _ in positions], positions))
    assert len(shown) > 25


def test_without_the_stage_everything_is_an_obstacle(device: str):
    rng = np.random.default_rng(6)
    positions = np.zeros((3, 3))
    planner = Planner(config_with(()), device=device)
    assert len(filtered(plan_of(planner, [sweep(rain(rng, 500, place)) for place in positions], positions))) > 300


def test_a_sweep_full_of_surfaces_is_kept(planner: Planner):
    """Its points are too many to be listed."""
    rng = np.random.default_rng(7)
    points = rain(rng, 9000, np.zeros(3))
    assert len(filtered(plan_of(planner, [sweep(points)], np.zeros((1, 3))))) > 1500
