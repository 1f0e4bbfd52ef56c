"""The acceleration that commands do not explain is found from the velocities of successive states."""

import dataclasses

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.dead_reckoning import DeadReckoning, MotionState, propagate
from aero_planner.onboard.disturbance_estimate import DisturbanceEstimate
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import ResponseSettings
from aero_planner.plan import VehicleState

VEHICLE = PlannerConfig().vehicle
RESPONSE = ResponseSettings()
PERIOD = 0.02
HOVER = np.array([VEHICLE.mass * VEHICLE.gravity, 0.0, 0.0, 0.0])


def fly(wind: list[float], *, seconds: float = 2.0, noise: float = 0.0, obeys: bool = True, resets: bool = False):
    """Hover in a wind that accelerates the drone [m/s^2], from 3 m/s on, and return the estimate and the velocity."""
    rng, estimate, reckoning = np.random.default_rng(0), DisturbanceEstimate(RESPONSE), DeadReckoning(VEHICLE, RESPONSE)
    motion = MotionState(0.0, np.zeros(3), np.array([3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), HOVER)
    previous = None
    for k in range(round(seconds / PERIOD)):
        seen = motion.velocity + rng.normal(0.0, noise, 3)
        state = VehicleState(motion.position, seen, motion.quaternion, time=motion.time)
        sample = VehicleSample(motion.time, state, True, obeys, 0.0, resets=k if resets else 0)
        if previous is not None:
            estimate.update(previous, reckoning.at(sample.time), sample)
        reckoning.correct(sample)
        reckoning.add_command(sample.time, HOVER if obeys else None)
        previous = sample
        motion = propagate(motion, HOVER, motion.time + PERIOD, VEHICLE, RESPONSE)
        motion = dataclasses.replace(motion, velocity=motion.velocity + PERIOD * np.array(wind))
    return estimate.acceleration, motion.velocity


@pytest.mark.parametrize("wind", [[0.0, 0.0, 0.0], [0.3, -0.2, 0.4]])
def test_it_is_wind_and_drag(wind: list[float]):
    found, velocity = fly(wind, seconds=4.0)
    np.testing.assert_allclose(found, np.array(wind) - RESPONSE.drag * velocity, atol=0.1)


def test_noise_of_the_velocity_is_averaged():
    found, _ = fly([0.0, 0.0, 0.4], seconds=4.0, noise=0.05)
    exact, _ = fly([0.0, 0.0, 0.4], seconds=4.0)
    assert np.abs(found - exact).max() < 0.4 < 0.05 / PERIOD


def test_it_is_zero_without_commands_and_after_resets_of_the_estimator():
    assert not fly([0.0, 0.0, 0.4], obeys=False)[0].any()
    assert not fly([0.0, 0.0, 0.4], resets=True)[0].any()
