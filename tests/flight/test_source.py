import gc
import re
import tracemalloc
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_viz.errors import UserError
from aero_viz.flight import FlightRules, FlightSource, StateNoise
from aero_viz.flight.sweep_cache import CACHED_BYTES
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel
from aero_viz.session.source import Source

LIDAR = LidarModel("small", points_per_sweep=2000)


@pytest.fixture
def planner() -> Planner:
    return Planner(PlannerConfig.preset("fast-cpu"), device="cpu", seed=4)


@pytest.fixture
def source() -> FlightSource:
    return FlightSource(scene("forest", seed=2, count=40), lidar=LIDAR, seed=4)


def fly(source: Source, planner: Planner, ticks: int):
    seen = []
    for _ in range(ticks):
        now = source.observe()
        source.advance(planner.plan(now.state, now.goal, now.points))
        now = source.observe()
        seen.append((now.time, np.asarray(now.state.position), np.asarray(now.state.quaternion), now.points))
    return seen


def assert_equal_flights(first, second):
    for a, b in zip(first, second, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)


def test_first_observation(source):
    now = source.observe()
    assert (now.time, len(now.sweeps), source.outcome, source.info.period) == (0.0, 30, None, 0.02)
    np.testing.assert_array_equal(now.state.position, [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(now.goal.position, [45.0, 0.0, 2.0])
    assert now.points.dtype == np.float32 and np.isfinite(now.points).all() and len(now.points) > 1000
    assert np.abs(source.info.world.distance(now.points)).max() < 0.15  # 6 sigma of the range noise
    assert source.info.closed_loop and source.info.times is None


def test_observe_has_no_side_effects(source, planner):
    fly(source, planner, 2)
    assert source.observe() is source.observe()
    with pytest.raises(ValueError, match="read-only"):
        source.observe().points[0] = 0.0


def test_a_new_sweep_replaces_the_oldest_every_tenth_of_a_second(source, planner):
    first = source.observe().points
    seen = fly(source, planner, 10)
    clouds = [first, *(points for *_, points in seen)]
    changed = [not np.array_equal(a, b) for a, b in pairwise(clouds)]
    assert changed == [False] * 4 + [True] + [False] * 4 + [True]


def test_flight_goes_toward_the_goal(source, planner):
    fly(source, planner, 60)
    assert source.observe().state.position[0] > 2.0 and source.outcome is None
    result = source.result()
    assert result.flight_time_s == pytest.approx(1.2) and result.length_m > 2.0


@pytest.mark.parametrize("ticks", [10, 13])  # at the end of a sweep, and within one
def test_restored_flight_continues_bit_for_bit(source, planner, ticks):
    fly(source, planner, ticks)
    checkpoint, history = source.checkpoint(), planner.history()
    first = fly(source, planner, 12)
    fly(source, planner, 3)
    source.restore(checkpoint)
    planner.restore(history)
    assert_equal_flights(first, fly(source, planner, 12))


@pytest.mark.parametrize("noise", [None, StateNoise(position=0.2, velocity=0.1, attitude=1.0)], ids=["exact", "noisy"])
@pytest.mark.parametrize("ticks", [0, 33])  # looking back to before the start, and within the seventh sweep
def test_points_that_are_not_cached_are_measured_again_bit_for_bit(planner, monkeypatch, ticks, noise):
    for module in ("source", "sweep_cache"):
        monkeypatch.setattr(f"aero_viz.flight.{module}.SWEEPS", 10)
    monkeypatch.setattr("aero_viz.flight.source.DEFAULT_MEMORY", 1.0)
    monkeypatch.setattr("aero_viz.flight.sweep_cache.CACHED_BYTES", 0)  # only the last ten sweeps
    mounted = LidarModel(
        "mounted", points_per_sweep=2000, mount_position=(0.1, 0.0, 0.05), mount_angles=(0.0, 20.0, 0.0)
    )
    source = FlightSource(scene("forest", seed=2, count=40), lidar=mounted, seed=4, noise=noise)
    fly(source, planner, ticks)
    before, history = source.observe(), planner.history()
    checkpoint: Any = source.checkpoint()
    first = fly(source, planner, 60)
    assert all(sweep.points is None for sweep in checkpoint.sweeps)
    source.restore(checkpoint)
    planner.restore(history)
    np.testing.assert_array_equal(source.observe().points, before.points)
    assert_equal_flights(first, fly(source, planner, 60))


def test_checkpoints_of_ten_minutes_fit_in_256_megabytes(planner, monkeypatch):
    monkeypatch.setattr("aero_viz.flight.sweep_cache.CACHED_BYTES", 0)
    tracemalloc.start()
    try:
        source, checkpoints = FlightSource(scene("forest", seed=2, count=40), lidar=LIDAR, seed=4), []
        fly(source, planner, 60)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(100):
            checkpoints.append((source.checkpoint(), planner.history()))
            fly(source, planner, 1)
        gc.collect()
        each = (tracemalloc.get_traced_memory()[0] - before) / len(checkpoints)
    finally:
        tracemalloc.stop()
    assert 30_000 * each + CACHED_BYTES < 256e6


def test_checkpoints_share_their_clouds(source, planner):
    fly(source, planner, 3)
    first = source.checkpoint()
    fly(source, planner, 1)
    second = source.checkpoint()
    assert all(a is b for a, b in zip(first.sweeps, second.sweeps, strict=True))


def test_restore_refuses_an_object_that_is_not_a_checkpoint(source):
    with pytest.raises(TypeError, match="dict is not a checkpoint"):
        source.restore({})


def test_same_seed_same_cloud():
    world = scene("forest", seed=2, count=40)
    a, b, c = (FlightSource(world, lidar=LIDAR, seed=seed).observe().points for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_goal_moves_and_returns_with_the_checkpoint(source, planner):
    checkpoint = source.checkpoint()
    source.set_goal([10.0, 8.0, 3.0])
    np.testing.assert_array_equal(source.observe().goal.position, [10.0, 8.0, 3.0])
    fly(source, planner, 1)
    source.restore(checkpoint)
    np.testing.assert_array_equal(source.observe().goal.position, [45.0, 0.0, 2.0])


@pytest.mark.parametrize("goal", [[1.0, 2.0], [1.0, float("nan"), 2.0], [1e30, 0.0, 2.0]])
def test_invalid_goals_are_refused_and_the_previous_goal_stays(source, goal):
    with pytest.raises(UserError, match=r"three finite numbers|within 1e\+08 m"):
        source.set_goal(goal)
    np.testing.assert_array_equal(source.observe().goal.position, [45.0, 0.0, 2.0])


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ([10.0, 5.0, 3.0], r"\(10, 5, 3\) lies inside an obstacle .* 0\.\d+ m deep in .*, so the drone flies as near"),
        ([10.0, 5.0, -0.4], r"lies 0\.40 m below the ground"),
        ([10.0, 5.0, -4.0], r"lies 4\.00 m below the ground"),
        ([9e4, 0.0, 2.0], r"\(90000, 0, 2\) lies outside the bounds .* x -?\d+ to \d+"),
    ],
)
def test_a_goal_that_no_drone_can_reach_is_flown_to_and_explained(source, planner, goal, words):
    source.set_goal(goal)
    fly(source, planner, 1)
    assert source.outcome is None and re.search(words, str(source.explanation))
    lower, upper = source.info.world.bounds
    assert (source.observe().goal.position >= lower).all() and (source.observe().goal.position <= upper).all()
    source.set_goal([45.0, 0.0, 2.0])
    assert source.explanation is None


def test_a_start_inside_an_obstacle_is_explained():
    world = World("pole", np.zeros(3), np.array([9.0, 0.0, 0.0]), spheres=np.array([[0.1, 0.0, 0.0, 0.5]]))
    source = FlightSource(world, lidar=LIDAR)
    assert source.outcome == "collision"
    assert source.explanation == source.result().explanation
    assert source.explanation is not None and re.match("The start .*inside an obstacle", source.explanation)


def test_a_flight_that_is_not_over_has_no_explanation(source, planner):
    fly(source, planner, 1)
    assert source.explanation is None


def test_arrived_flight_stays_until_the_goal_moves(planner):
    world = World("near", np.array([0.0, 0.0, 2.0]), np.array([0.5, 0.0, 2.0]))
    source = FlightSource(world, lidar=LIDAR)
    assert source.outcome == "arrived"
    plan = planner.plan(source.observe().state, source.observe().goal, source.observe().points)
    source.advance(plan)
    assert source.observe().time == 0.0
    source.set_goal([9.0, 0.0, 2.0])
    source.advance(plan)
    assert source.outcome is None and source.observe().time == pytest.approx(0.02)


def test_noise_separates_estimated_and_true_state(planner):
    noise = StateNoise(position=0.2, velocity=0.1, attitude=1.0)
    source = FlightSource(scene("forest", seed=2, count=40), lidar=LIDAR, seed=4, noise=noise)
    for tick in range(3):
        now = source.observe()
        assert now.true_state is not None
        if tick == 0:
            np.testing.assert_array_equal(now.true_state.position, [0.0, 0.0, 2.0])
        apart = np.linalg.norm(np.subtract(now.state.position, now.true_state.position))
        assert 0.01 < apart < 1.0 and not np.array_equal(now.state.quaternion, now.true_state.quaternion)
        source.advance(planner.plan(now.state, now.goal, now.points))
    checkpoint, history = source.checkpoint(), planner.history()
    first = fly(source, planner, 6)
    source.restore(checkpoint)
    planner.restore(history)
    for a, b in zip(first, fly(source, planner, 6), strict=True):
        np.testing.assert_array_equal(a[1], b[1])


def test_one_plan_for_five_ticks(planner):
    rules = FlightRules(ticks_per_plan=5)
    source = FlightSource(scene("forest", seed=2, count=40), lidar=LIDAR, seed=4, rules=rules)
    assert source.info.period == pytest.approx(0.1)
    now = source.observe()
    plan = planner.plan(now.state, now.goal, now.points)
    source.advance(plan)
    assert source.observe().time == pytest.approx(0.1) and source.result().flight_time_s == pytest.approx(0.1)
    # At the last of the five ticks, 0.08 s into controls 0.05 s apart.
    expected = plan.command[1] + 0.6 * (plan.command[2] - plan.command[1])
    np.testing.assert_allclose(source.simulator.vehicle.control.numpy()[0], expected, atol=1e-4)


def test_a_flight_cannot_seek(source):
    with pytest.raises(TypeError, match="restore"):
        source.seek(1.0)


def test_a_tick_that_is_longer_than_a_sweep_is_a_users_error():
    with pytest.raises(UserError, match="less than the tick"):
        FlightSource(scene("forest", seed=0, count=1), rules=FlightRules(period=0.2))


def test_a_flight_among_moving_obstacles_repeats_and_ends_where_they_are():
    pole = np.array([[9.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.4, 5.0]])
    motion = np.array([[-2.0, 0.0, 9.0]])
    moving = World("pole", np.array([0.0, 0.0, 2.0]), np.array([8.0, 0.0, 2.0]), cylinders=pole, motion=motion)
    source = FlightSource(moving, lidar=LIDAR)
    hover: Any = SimpleNamespace(command=np.array([[9.81, 0.0, 0.0, 0.0]] * 2, dtype=np.float32), model="ctbr")
    for _ in range(60):
        source.advance(hover)
    checkpoint = source.checkpoint()
    while source.outcome is None:
        source.advance(hover)
    points, result = source.observe().points.copy(), source.result()
    # The axis is 0.65 m away after 4.175 s; at time 0 and at the end of its way the pole is elsewhere.
    assert result.reason == "collision" and abs(result.flight_time_s - 4.18) < 0.011
    assert "from cylinder 0" in str(result.explanation)
    source.restore(checkpoint)
    while source.outcome is None:
        source.advance(hover)
    np.testing.assert_array_equal(source.observe().points, points)


def test_a_pillar_that_moves_is_found_and_a_restored_flight_plans_the_same():
    pillars = np.array([[6.0, -2.0, 0.0, 0.0, 0.0, 1.0, 0.3, 6.0], [5.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.4, 6.0]])
    motion = np.array([[0.0, 1.2, 9.0], [0.0, 0.0, 0.0]])
    world = World("two", np.array([0.0, 0.0, 2.0]), np.array([30.0, 0.0, 2.0]), cylinders=pillars, motion=motion)
    source = FlightSource(world, seed=1)
    planner = Planner(PlannerConfig.preset("fast-cpu").replace({"vehicle.speed_limit": 2.0}), device="cpu", seed=4)

    def moving(ticks: int) -> list[Any]:
        found = []
        for _ in range(ticks):
            now = source.observe()
            plan = planner.plan(now.state, now.goal, now.sweeps)
            found.append(plan.moving)
            source.advance(plan)
        return found

    moving(16)
    checkpoint, history = source.checkpoint(), planner.history()
    first = moving(12)
    axis = world.at(source.simulator.time - 0.02).cylinders[0, :2]
    np.testing.assert_allclose(first[-1].positions, [axis], atol=0.15)
    np.testing.assert_allclose(first[-1].velocities, [[0.0, 1.2]], atol=0.3)
    source.restore(checkpoint)
    planner.restore(history)
    for before, again in zip(first, moving(12), strict=True):
        np.testing.assert_array_equal(before.positions, again.positions)
        np.testing.assert_array_equal(before.radii, again.radii)
