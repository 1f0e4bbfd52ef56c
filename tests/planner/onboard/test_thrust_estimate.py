"""The hover thrust is corrected from what the commands cause."""

import dataclasses
import math

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.dead_reckoning import DeadReckoning, propagate
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import ResponseSettings, ThrustSettings
from aero_planner.onboard.thrust_estimate import ThrustEstimate
from aero_planner.plan import VehicleState
from aero_planner.quaternions import quaternion_from_angles

VEHICLE = PlannerConfig().vehicle
PERIOD = 0.01


def fly(seconds, *, factor, tilt=0.0, noise=0.0, obeys=True, settings=None, drag=0.3):
    """Fly with a thrust that is `factor` times what it should be, and return the estimate."""
    rng, response = np.random.default_rng(0), ResponseSettings()
    truth = dataclasses.replace(response, drag=drag)
    estimate = ThrustEstimate(VEHICLE, settings or ThrustSettings())
    reckoning = DeadReckoning(VEHICLE, response)
    position, velocity = np.zeros(3), np.array([4.0, 0.0, 0.0])
    attitude, motion, previous = quaternion_from_angles(0.0, tilt, 0.0), None, None
    for k in range(round(seconds / PERIOD)):
        seen = velocity + rng.normal(0.0, noise, 3)
        sample = VehicleSample(k * PERIOD, VehicleState(position, seen, attitude, time=k * PERIOD), True, obeys, 0.0)
        if previous is not None:
            estimate.update(previous, reckoning.at(sample.time), sample)
        reckoning.correct(sample)
        previous = sample
        lift = VEHICLE.gravity * (1.0 + 0.2 * math.sin(k * PERIOD)) / math.cos(math.radians(tilt)) - 2.0 * seen[2]
        command = np.array([VEHICLE.mass * lift, 0.0, 0.0, 0.0])
        reckoning.add_command(sample.time, command if obeys else None)
        force = command * [factor / estimate.gain, 1.0, 1.0, 1.0]
        reckoned = reckoning.at(sample.time)
        assert reckoned is not None
        start = dataclasses.replace(reckoned, velocity=velocity, control=motion and motion.control)
        motion = propagate(start, force, sample.time + PERIOD, VEHICLE, truth)
        velocity = motion.velocity
    return estimate.gain


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_a_wrong_hover_thrust_is_found(factor, tilt):
    assert fly(10.0, factor=factor, tilt=tilt, noise=0.05) == pytest.approx(factor, rel=0.03)


def test_drag_is_not_taken_for_thrust():
    assert fly(10.0, factor=1.0, tilt=20.0, drag=0.9) == pytest.approx(1.0, abs=0.02)


def test_nothing_is_learnt_without_commands_or_when_it_is_switched_off():
    assert fly(3.0, factor=0.8, obeys=False) == 1.0
    assert fly(3.0, factor=0.8, settings=ThrustSettings(adapt=False)) == 1.0


def test_a_far_wrong_thrust_is_bounded_and_logged(caplog):
    assert fly(20.0, factor=0.4) == pytest.approx(1.0 / 1.5)
    assert "0.90 times what thrust.hover_thrust says" in caplog.text


def test_the_logged_hover_thrust_follows_the_thrust_curve(caplog):
    fly(5.0, factor=0.8, settings=ThrustSettings(hover_thrust=0.5, curve=1.0))
    assert "set it to 0.527" in caplog.text  # 0.5 / sqrt(0.9): the thrust grows with the square of the signal
