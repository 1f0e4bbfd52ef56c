"""Braking paths: where on them a drone is, and that the stop controller follows them."""

from typing import Any

import numpy as np
import pytest

from aero_planner import Goal, Planner, PlannerConfig, VehicleState
from aero_planner.onboard.braking_path import PATH_POINTS, BrakingPath, choose_path
from aero_planner.onboard.dead_reckoning import MotionState, propagate
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.settings import BrakeSettings, ResponseSettings
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.watchdog import Heartbeat

VEHICLE = PlannerConfig().vehicle
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def curve(period: float = 0.05, duration: float = 1.25) -> BrakingPath:
    """Return a path from 4 m/s north to rest that bears left by 30 deg."""
    t = np.arange(0.0, duration + 1e-9, period)
    angle = np.radians(30.0) * t / duration
    speed = 4.0 * (1.0 - t / duration)
    velocities = np.stack([speed * np.cos(angle), speed * np.sin(angle), 0.0 * t], axis=1)
    steps = 0.5 * period * (velocities[1:] + velocities[:-1])
    return BrakingPath(period, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), velocities)


def test_the_place_nearest_to_the_drone_is_found():
    path = curve()
    place = path.near(0.5 * (path.positions[4] + path.positions[5]) + [0.0, 0.0, 0.3], 0.0)
    assert place is not None
    np.testing.assert_allclose(place.position, 0.5 * (path.positions[4] + path.positions[5]), atol=1e-6)
    np.testing.assert_allclose(place.velocity, 0.5 * (path.velocities[4] + path.velocities[5]), atol=1e-6)
    np.testing.assert_allclose(place.acceleration, (path.velocities[5] - path.velocities[4]) / 0.05, atol=1e-6)
    ahead = path.near(path.positions[4], 0.1)
    assert ahead is not None
    np.testing.assert_allclose(ahead.acceleration, (path.velocities[7] - path.velocities[6]) / 0.05, atol=1e-6)


def test_before_its_start_and_past_its_end_the_path_ends_are_used():
    path = curve()
    start, end = path.near(np.array([-0.5, 0.0, 0.0]), 0.0), path.near(path.positions[-1] + [0.3, 0.2, 0.0], 0.0)
    assert start is not None and end is not None
    np.testing.assert_allclose(start.velocity, path.velocities[0])
    np.testing.assert_allclose(end.position, path.positions[-1])
    np.testing.assert_array_equal([end.velocity, end.acceleration], np.zeros((2, 3)))
    assert path.near(np.array([0.0, 5.0, 0.0]), 0.0) is None


def test_the_drone_stays_on_the_path_and_stops_no_later_than_it():
    path, response = curve(), ResponseSettings()
    stop = StopController(VEHICLE, BrakeSettings())
    motion = MotionState(0.0, np.zeros(3), np.array([4.0, 0.0, 0.0]), LEVEL, stop.hover)
    offsets = []
    for k in range(150):
        motion = propagate(motion, stop.command(motion, path=path).control, 0.02 * (k + 1), VEHICLE, response)
        offsets.append(np.linalg.norm(path.positions - motion.position, axis=1).min())
    assert max(offsets) < 0.3 and motion.speed < 0.15
    # Without a path it stops straight ahead.
    assert motion.position[1] > 0.15
    straight = MotionState(0.0, np.zeros(3), np.array([4.0, 0.0, 0.0]), LEVEL, stop.hover)
    for k in range(150):
        straight = propagate(straight, stop.command(straight).control, 0.02 * (k + 1), VEHICLE, response)
    assert abs(straight.position[1]) < 1e-6 and straight.position[0] < 4.0


@pytest.mark.parametrize("place", [10, 20, 23, 25])
def test_a_drone_at_rest_on_the_path_stays_there(place: int):
    path, stop = curve(), StopController(VEHICLE, BrakeSettings())
    motion = MotionState(0.0, path.positions[place], np.zeros(3), LEVEL)
    np.testing.assert_allclose(stop.command(motion, path=path).control, stop.hover, atol=1e-6)


@pytest.fixture(scope="module")
def planner() -> Any:
    planner = Planner(PlannerConfig.preset("fast-cpu"), device="cpu", threads=1)
    yield planner
    planner.close()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_chosen_path_avoids_what_is_ahead(planner: Planner, side: float):
    # A wall 2.5 m ahead that is open on one side.
    y, z = np.meshgrid(np.arange(-0.3, 4.0, 0.1), np.arange(-2.0, 2.0, 0.1))
    wall = np.stack([np.full(y.size, 2.0), side * y.ravel(), z.ravel()], axis=1).astype(np.float32)
    state = VehicleState(np.zeros(3), np.array([5.0, 0.0, 0.0]), LEVEL)
    plan = planner.plan(state, Goal(np.array([20.0, 0.0, 0.0])), wall)
    assert plan.braking is not None and plan.braking.positions.shape[1:] == (planner.config.sampling.steps + 1, 3)
    path = choose_path(plan, planner.config.sampling.dt)
    assert path is not None and len(path.positions) <= PATH_POINTS
    assert side * path.positions[-1][1] < -0.3
    # Nothing ahead: straight on.
    free = planner.plan(state, Goal(np.array([20.0, 0.0, 0.0])), wall + np.float32(30.0))
    path = choose_path(free, planner.config.sampling.dt)
    assert path is not None and abs(path.positions[-1][1]) < 0.1


def test_the_failsafe_process_reads_the_path_and_the_control_that_the_node_wrote():
    file = HeartbeatMemory.create_file()
    writer, reader = HeartbeatMemory(file), HeartbeatMemory(file)
    motion = MotionState(5.0, np.zeros(3), np.ones(3), LEVEL, np.array([9.0, 0.1, 0.2, 0.3]))
    path = curve()
    writer.write(Heartbeat(5.0, motion, np.array([9.81, 0.0, 0.0, 0.0]), None, path), None)
    shared = reader.read()
    assert shared is not None and shared.heartbeat.path is not None and shared.heartbeat.motion is not None
    for name in ("positions", "velocities"):
        np.testing.assert_array_equal(getattr(shared.heartbeat.path, name), getattr(path, name))
    assert shared.heartbeat.path.period == path.period
    np.testing.assert_array_equal(shared.heartbeat.motion.control, motion.control)
