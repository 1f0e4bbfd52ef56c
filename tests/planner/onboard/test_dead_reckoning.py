"""Dead reckoning against RK4, and the stop controller on the propagated model."""

import math

import numpy as np
import pytest

from aero_planner import PlannerConfig, VehicleState
from aero_planner.onboard.dead_reckoning import DeadReckoning, MotionState, acceleration, propagate
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import BrakeSettings, ResponseSettings
from aero_planner.onboard.stop_controller import StopController
from aero_planner.quaternions import integrate_rates
from tests.planner.reference import rotation

VEHICLE = PlannerConfig().vehicle
HOVER = np.array([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def rk4(motion: MotionState, command: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """dp = v, dv = R(q) [0, 0, F_t] / m + g, dq = 1/2 q (x) [0, omega], with a thousand RK4 steps."""

    def slope(y: np.ndarray) -> np.ndarray:
        w, x, y_, z = y[6:]
        p, q, r = command[1:]
        turn = 0.5 * np.array(
            [-x * p - y_ * q - z * r, w * p + y_ * r - z * q, w * q - x * r + z * p, w * r + x * q - y_ * p]
        )
        lift = rotation(y[6:]) @ [0.0, 0.0, command[0]] / VEHICLE.mass - [0.0, 0.0, VEHICLE.gravity]
        return np.concatenate([y[3:6], lift, turn])

    y, h = np.concatenate([motion.position, motion.velocity, motion.quaternion]), (time - motion.time) / 1000
    for _ in range(1000):
        a = slope(y)
        b = slope(y + 0.5 * h * a)
        c = slope(y + 0.5 * h * b)
        d = slope(y + h * c)
        y = y + h / 6.0 * (a + 2 * b + 2 * c + d)
    return y[:3], y[3:6], y[6:]


def tilted(angle: float, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> np.ndarray:
    return np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.array(axis))])


def test_propagate_matches_the_vehicle_model():
    motion = MotionState(5.0, np.array([1.0, -2.0, 3.0]), np.array([4.0, 1.0, -0.5]), tilted(0.4, (0.6, 0.8, 0.0)))
    command = np.array([12.0, 1.5, -2.0, 0.7])
    moved = propagate(motion, command, 5.05, VEHICLE)
    position, velocity, quaternion = rk4(motion, command, 5.05)
    np.testing.assert_allclose(moved.quaternion, quaternion, atol=1e-9)
    np.testing.assert_allclose(moved.velocity, velocity, atol=2e-3)  # the thrust acts in its direction at half time
    np.testing.assert_allclose(moved.position, position, atol=1e-3)
    assert moved.time == 5.05 and moved.is_finite
    np.testing.assert_allclose(acceleration(LEVEL, HOVER[0], VEHICLE), 0.0, atol=1e-12)


def test_without_a_command_the_velocity_is_constant():
    motion = MotionState(0.0, np.zeros(3), np.array([1.0, 2.0, 0.0]), tilted(0.3))
    moved = propagate(motion, None, 2.0, VEHICLE)
    np.testing.assert_array_equal(moved.position, [2.0, 4.0, 0.0])
    np.testing.assert_array_equal(moved.velocity, motion.velocity)


def test_propagate_with_lags_matches_the_simulated_vehicle():
    response = ResponseSettings(rate_lag=0.07, thrust_lag=0.045, drag=0.3)
    motion = MotionState(0.0, np.zeros(3), np.array([4.0, 1.0, -0.5]), tilted(0.3), HOVER)
    command = np.array([12.0, 1.5, -2.0, 0.7])
    # The differential equations of motion and control, in steps of 0.1 ms.
    p, v, q, u, h = motion.position, motion.velocity, motion.quaternion, HOVER, 1e-4
    lags = np.array([0.045, 0.07, 0.07, 0.07])
    for _ in range(2000):
        lift = rotation(q) @ [0.0, 0.0, u[0]] / VEHICLE.mass - [0.0, 0.0, VEHICLE.gravity] - 0.3 * v
        p, v, q, u = p + h * v, v + h * lift, integrate_rates(q, u[1:], h), u + h / lags * (command - u)
    moved = propagate(motion, command, 0.2, VEHICLE, response)
    assert moved.control is not None
    np.testing.assert_allclose(moved.control, u, atol=0.01)
    np.testing.assert_allclose(moved.velocity, v, atol=0.01)
    np.testing.assert_allclose(moved.position, p, atol=0.005)
    assert abs(moved.quaternion @ q) > 1.0 - 1e-6


def sample(motion: MotionState) -> VehicleSample:
    state = VehicleState(motion.position, motion.velocity, motion.quaternion, None, motion.time)
    return VehicleSample(motion.time, state, True, True, motion.time)


def test_dead_reckoning_applies_the_commands_that_were_sent():
    rng = np.random.default_rng(0)
    truth = MotionState(10.0, np.zeros(3), np.array([3.0, 0.0, 0.0]), LEVEL)
    reckoning = DeadReckoning(VEHICLE)
    assert reckoning.at(10.0) is None
    reckoning.correct(sample(truth))
    delayed = truth
    for k in range(60):
        command = HOVER + rng.normal(size=4) * (1.0, 0.5, 0.5, 0.5)
        reckoning.add_command(10.0 + 0.02 * k, command)
        truth = propagate(truth, command, 10.0 + 0.02 * (k + 1), VEHICLE)
        if k == 30:
            delayed = truth
        if k == 35:
            reckoning.correct(sample(delayed))  # a state that is 0.1 s old when it arrives
        if k % 7 == 0:
            found = reckoning.at(truth.time)
            assert found is not None
            np.testing.assert_allclose(found.position, truth.position, atol=1e-9)
            np.testing.assert_allclose(found.quaternion, truth.quaternion, atol=1e-9)


def test_a_drone_that_does_not_obey_moves_at_constant_velocity():
    reckoning = DeadReckoning(VEHICLE)
    reckoning.correct(sample(MotionState(1.0, np.zeros(3), np.array([2.0, 0.0, 0.0]), tilted(0.5))))
    reckoning.add_command(1.0, HOVER)
    reckoning.add_command(1.0, None)
    found = reckoning.at(1.5)
    assert found is not None
    np.testing.assert_allclose(found.velocity, [2.0, 0.0, 0.0])


def test_forgotten_commands_leave_the_velocity_as_it_is():
    reckoning = DeadReckoning(VEHICLE)
    reckoning.correct(sample(MotionState(1.0, np.zeros(3), np.array([2.0, 0.0, 0.0]), tilted(0.5))))
    reckoning.add_command(1.0, HOVER)
    obeyed, later = reckoning.at(1.2), reckoning.at(1.5)
    reckoning.forget_commands(1.2)
    reckoning.forget_commands(1.2)
    found = reckoning.at(1.5)
    assert obeyed is not None and later is not None and found is not None
    np.testing.assert_allclose(found.velocity, obeyed.velocity)
    assert found.control is None and np.linalg.norm(later.velocity - obeyed.velocity) > 1.0
    reckoning.add_command(1.5, HOVER)
    continued = reckoning.at(1.6)
    assert continued is not None and continued.control is not None


@pytest.mark.parametrize("seed", range(12))
def test_the_drone_comes_to_rest_from_any_attitude_and_holds(seed: int):
    rng = np.random.default_rng(seed)
    axis, velocity, angle = rng.normal(size=3), rng.uniform(-6, 6, 3), rng.uniform(0, math.pi)
    unit = tuple(axis / np.linalg.norm(axis))
    motion = MotionState(0.0, np.array([0.0, 0.0, 50.0]), velocity, tilted(angle, unit))
    stop, hold = StopController(VEHICLE, BrakeSettings()), None
    for k in range(400):
        if hold is None and motion.speed < 0.3:
            hold = motion.position
        command = stop.command(motion, hold=hold).control
        assert VEHICLE.thrust_min <= command[0] <= VEHICLE.thrust_max
        assert np.abs(command[1:3]).max() <= VEHICLE.rate_xy_max and command[3] == 0.0
        motion = propagate(motion, command, 0.02 * (k + 1), VEHICLE)
    assert motion.speed < 0.05 and hold is not None
    assert np.linalg.norm(motion.position - hold) < 0.05
    assert rotation(motion.quaternion)[2, 2] > 0.999


def test_a_level_drone_at_six_metres_per_second_stops_within_five_metres():
    motion = MotionState(0.0, np.zeros(3), np.array([6.0, 0.0, 0.0]), LEVEL)
    stop = StopController(VEHICLE, BrakeSettings())
    for k in range(200):
        motion = propagate(motion, stop.command(motion).control, 0.02 * (k + 1), VEHICLE)
    assert 3.0 < motion.position[0] < 5.0 and abs(motion.position[2]) < 0.5
