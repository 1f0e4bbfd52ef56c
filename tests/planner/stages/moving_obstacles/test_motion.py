"""Velocities of obstacles, estimated from sweeps of a simulated pillar, and the clearance from where they will be."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Planner, Sweeps, VehicleState
from tests.planner.cases import assert_same, config_of
from tests.planner.pillars import GOAL, RADIUS, dynamic_obstacles, plan_from, sweeps_of


@pytest.mark.parametrize("own", [(0.0, 0.0, 0.0), (4.0, 0.0, 0.5)])
@pytest.mark.parametrize("velocity", [(1.0, 0.0), (-1.2, 1.2), (0.0, 2.0), (-0.6, -0.4)])
def test_a_pillar_that_moves_is_found(device: str, velocity: tuple[float, float], own: tuple[float, float, float]):
    planner, axis = Planner(config_of(), device=device), np.array([5.0, 1.0])
    positions, velocities, radii = dynamic_obstacles(
        plan_from(planner, *sweeps_of([(axis, np.array(velocity))], np.array(own)), later=0.04)
    )
    assert len(positions) == 1
    np.testing.assert_allclose(velocities[0], velocity, atol=0.15)
    np.testing.assert_allclose(positions[0], axis + 0.04 * np.array(velocity), atol=0.1)
    assert abs(radii[0] - RADIUS) < 0.06


@pytest.mark.parametrize(
    ("place", "velocity"),
    [((6.0, 0.5), (-5.0, 0.0)), ((5.0, 2.0), (0.0, 6.0)), ((9.0, -1.0), (-4.5, 5.5)), ((15.0, 1.0), (-6.0, 0.0))],
)
def test_a_fast_pillar_is_found_from_afar(device: str, place: tuple[float, float], velocity: tuple[float, float]):
    sweeps = sweeps_of([(np.array(place), np.array(velocity))], np.array([5.0, 0.0, 0.0]))
    _, velocities, _ = dynamic_obstacles(plan_from(Planner(config_of(), device=device), *sweeps))
    np.testing.assert_allclose(velocities, [velocity], atol=0.3)


def test_sweeps_of_a_fast_planner_show_the_motion(device: str):
    """A node that plans at 30 Hz makes a sweep of what it has received since the plan before."""
    planner, axis, velocity = Planner(config_of(), device=device), np.array([5.0, 1.0]), np.array([0.0, 0.8])
    positions, velocities, _ = dynamic_obstacles(
        plan_from(planner, *sweeps_of([(axis, velocity)], np.array([2.0, 0.0, 0.0]), count=24, period=0.033))
    )
    np.testing.assert_allclose(velocities, [velocity], atol=0.15)
    np.testing.assert_allclose(positions, [axis], atol=0.1)


@pytest.mark.parametrize("own", [(0.0, 0.0, 0.0), (6.0, 0.0, 0.0), (0.0, 6.0, 1.0), (3.0, -3.0, 0.0)])
def test_pillars_that_stand_do_not_move(device: str, own: tuple[float, float, float]):
    """Neither do those that come out from behind another one."""
    planner = Planner(config_of(), device=device)
    places = [(3.0, 1.5), (6.0, 2.6), (4.0, -2.0), (7.0, -2.8), (-3.0, 2.0), (-6.0, 3.6)]
    pillars = [(np.array(place), np.zeros(2)) for place in places]
    assert len(dynamic_obstacles(plan_from(planner, *sweeps_of(pillars, np.array(own))))[0]) == 0


def test_a_pillar_is_followed_while_it_is_hidden(device: str):
    planner, axis, velocity = Planner(config_of(), device=device), np.array([5.0, 0.5]), np.array([0.0, 1.0])
    sweeps, position = sweeps_of([(axis, velocity)], np.zeros(3))
    hidden = Sweeps()
    for k, (points, arrival) in enumerate(zip(sweeps, sweeps.arrivals, strict=True)):
        points = points if k < len(sweeps) - 2 else np.zeros((0, 3), np.float32)
        hidden = hidden.add(points, limit=30, arrival=arrival)
    positions, velocities, _ = dynamic_obstacles(plan_from(planner, hidden, position))
    np.testing.assert_allclose(positions, [axis], atol=0.12)
    np.testing.assert_allclose(velocities, [velocity], atol=0.15)


def test_the_clearance_is_that_of_the_predicted_pillar(device: str):
    planner = Planner(config_of(costs__distance_max=3.0), device=device)
    sweeps, position = sweeps_of([(np.array([3.0, 2.0]), np.array([0.0, -1.5]))], np.zeros(3))
    plan = plan_from(planner, sweeps, position)
    positions, velocities, radii = dynamic_obstacles(plan)
    x, config = plan.positions[:, 1:].astype(np.float64), planner.config
    t = config.sampling.dt * np.arange(1, x.shape[1] + 1)
    gap = np.linalg.norm(x[..., :2] - positions[0] - t[:, None] * velocities[0], axis=-1) - radii[0] - 0.1 * t
    points = np.asarray(plan.filtered_points, dtype=np.float64)
    nearest = np.linalg.norm(x[..., None, :] - points, axis=-1).min(axis=-1)
    expected = np.minimum(np.minimum(nearest, np.maximum(gap, 0.0)), config.costs.distance_max)
    np.testing.assert_allclose(plan.clearance, expected, atol=1e-4)
    assert (gap < np.minimum(nearest, config.costs.distance_max) - 0.05).any()  # it is the nearest somewhere


def test_plans_start_after_the_delay(device: str):
    sweeps, position = sweeps_of([(np.array([5.0, 1.0]), np.array([0.0, 1.0]))], np.zeros(3))
    found = []
    for delay in (0.0, 0.2):
        planner = Planner(config_of(vehicle__delay=delay), device=device)
        found.append(dynamic_obstacles(plan_from(planner, sweeps, position)))
    np.testing.assert_allclose(found[1][0] - found[0][0], 0.2 * found[0][1], atol=1e-5)


@pytest.mark.parametrize("velocity", [(0.0, 3.0), (1.0, -5.0), (-2.0, 2.0)])
@pytest.mark.parametrize("standing", [False, True])
def test_points_of_places_that_a_pillar_has_left_are_forgotten(
    device: str, velocity: tuple[float, float], standing: bool
):
    """A slow drone forgets them. A pillar that stands beside its way keeps its points."""
    axis, moves = np.array([6.0, 1.0]), np.array(velocity)
    left = axis - 0.75 * moves
    normal = np.array([moves[1], -moves[0]]) / np.linalg.norm(moves)
    beside = left - 1.2 * np.sign(normal @ left) * normal
    pillars = [(axis, moves), *([(beside, np.zeros(2))] if standing else [])]
    sweeps = sweeps_of(pillars, np.zeros(3), count=10)
    places = {}
    for limit in (3.0, 7.0):
        plan = plan_from(Planner(config_of(vehicle__speed_limit=limit), device=device), *sweeps)
        places[limit] = plan.filtered_points[:, :2]

    def near(place: Any, limit: float) -> int:
        return int(np.sum(np.linalg.norm(places[limit] - place, axis=1) < RADIUS + 0.1))

    assert near(left, 3.0) == 0
    assert standing or near(left, 7.0) > 5
    assert near(axis, 3.0) > 5, "the newest points stay"
    assert near(beside, 3.0) == near(beside, 7.0) and (near(beside, 3.0) > 5) == standing


def test_nothing_moves_if_it_is_not_looked_for(device: str):
    planner = Planner(config_of(moving_obstacles__predict=False), device=device)
    sweeps, position = sweeps_of([(np.array([5.0, 1.0]), np.array([0.0, 1.0]))], np.zeros(3))
    assert len(dynamic_obstacles(plan_from(planner, sweeps, position))[0]) == 0


def test_old_sweeps_show_no_motion(device: str):
    planner = Planner(config_of(), device=device)
    sweeps, position = sweeps_of([(np.array([5.0, 1.0]), np.array([0.0, 1.0]))], np.zeros(3))
    assert len(dynamic_obstacles(plan_from(planner, sweeps, position, later=0.6))[0]) == 0


@pytest.mark.parametrize("speed", [1.0, 4.0])
@pytest.mark.parametrize(("count", "limit", "whole"), [(10, 30, None), (26, 20, 12)])
def test_the_motion_depends_on_the_sweeps_alone(device: str, count: int, limit: int, whole: int | None, speed: float):
    """A planner that is given all sweeps at once plans as one that they reached one by one: a flight can be rewound."""
    pillar = np.array([5.0, 1.0]), np.array([0.0, speed])
    sweeps, position = sweeps_of([pillar], np.array([3.0, 0.0, 0.4]), count=count)
    one_by_one, at_once = (Planner(config_of(), device=device, seed=1) for _ in range(2))
    part = Sweeps(whole=whole)
    for points, arrival in zip(sweeps, sweeps.arrivals, strict=True):
        part = part.add(points, limit=limit, arrival=arrival)
        plan_from(one_by_one, part, position)
    one_by_one.reset()
    expected = plan_from(at_once, Sweeps(part, whole=whole, arrivals=part.arrivals), position)
    assert_same(plan_from(one_by_one, part, position), expected)
    assert len(dynamic_obstacles(expected)[0]) == 1


def test_stored_sweeps_show_the_same_motion(device: str):
    pillar = np.array([5.0, 1.0]), np.array([0.0, 1.0])
    sweeps, position = sweeps_of([pillar], np.array([3.0, 0.0, 0.0]), count=12)
    single, batch = Planner(config_of(), device=device), Planner(config_of(), device=device, batch=2)
    plan_from(single, sweeps, position)
    batch.reserve_sweeps(len(sweeps), sum(map(len, sweeps)))
    for row, (points, arrival) in enumerate(zip(sweeps, sweeps.arrivals, strict=True)):
        assert arrival is not None
        batch.inputs.position.assign(np.array([arrival.position] * 2, np.float32))
        batch.store_sweep(row, wp.array(np.array([points] * 2), dtype=wp.vec3, device=device), time=arrival.time)
    newest = sweeps.arrivals[-1]
    assert newest is not None
    batch.inputs.time.assign(np.array([newest.time] * 2))
    batch.inputs.quaternion.assign(np.array([[1.0, 0.0, 0.0, 0.0]] * 2, np.float32))
    batch.launch()
    for b in range(2):
        found, expected = (planner.arrays_of("moving_obstacles") for planner in (batch, single))
        assert found["dynamic_count"].numpy()[b] == expected["dynamic_count"].numpy()[0] == 1
        for name in ("dynamic_position", "dynamic_velocity", "dynamic_radius"):
            np.testing.assert_array_equal(found[name].numpy()[b, 0], expected[name].numpy()[0, 0])
        for name in ("occupied", "fine_range"):
            ours, expected = (getattr(planner.outputs, name).numpy() for planner in (batch, single))
            np.testing.assert_array_equal(ours[b], expected[0])


@pytest.mark.parametrize("changes", [{"moving_obstacles__predict": False}, {"costs__q_track": 9.0}, None])
def test_the_same_sweeps_show_the_motion_again(device: str, changes: dict[str, Any] | None):
    """A paused flight is planned with other parameters and back, and a planner may get a joined cloud meanwhile."""
    planner = Planner(config_of(), device=device)
    sweeps, position = sweeps_of([(np.array([5.0, 1.0]), np.array([0.0, 1.0]))], np.zeros(3))
    first = dynamic_obstacles(plan_from(planner, sweeps, position))
    assert len(first[0]) == 1
    if changes is None:
        state = VehicleState(position, np.zeros(3), (1.0, 0.0, 0.0, 0.0), time=1.7)
        assert len(dynamic_obstacles(planner.plan(state, GOAL, sweeps.points))[0]) == 0
    else:
        planner.configure(config_of(**changes))
        count = len(dynamic_obstacles(plan_from(planner, sweeps, position))[0])
        assert count == ("moving_obstacles__predict" not in changes)
        planner.configure(config_of())
    for found, expected in zip(dynamic_obstacles(plan_from(planner, sweeps, position)), first, strict=True):
        np.testing.assert_array_equal(found, expected)
