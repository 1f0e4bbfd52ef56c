import math

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner import Planner, VehicleState
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.interfaces import PointPacket, VehicleSample
from aero_planner.onboard.plan_schedule import PlanSchedule
from aero_planner.onboard.replanner import ControlSnapshot, Replanner, speed_share
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.simulated import Clock, Simulation

HOVER = np.array([0.0, 0.0, 2.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def walls() -> NDArray[np.float32]:
    """Return points on two walls and the floor of a room of 10 m x 10 m x 4 m [m], shape [P, 3], world frame."""
    points = np.random.default_rng(0).uniform((-5.0, -5.0, 0.0), (5.0, 5.0, 4.0), (30_000, 3))
    points[0::3, 0], points[1::3, 1], points[2::3, 2] = 4.8, -5.3, -0.1  # not at the borders of voxels
    return points.astype(np.float32)


@pytest.fixture
def hovering(small_planner: Planner, clock: Clock) -> Replanner:
    """Two seconds of a hover in a room, without a goal; the drift is measured meanwhile."""
    replanner = Replanner(small_planner, OnboardConfig(), PlanSchedule(), clock)
    points = walls() - HOVER.astype(np.float32)
    for k in range(100):
        clock.now += 0.02
        state = VehicleState(HOVER, np.zeros(3), LEVEL, time=clock.now)
        sample = VehicleSample(clock.now, state, armed=True, offboard=True, heartbeat_time=clock.now)
        packet = points[k % 10 :: 10]
        replanner.add_arrival(sample)
        replanner.add_arrival(PointPacket(packet, np.full(len(packet), clock.now - 0.01)))
        motion = MotionState(clock.now, HOVER, np.zeros(3), LEVEL)
        assert replanner.plan_once(ControlSnapshot(sample, motion, None, 0.0, None, False, np.zeros(3))) is None
    return replanner


def test_a_measured_drift_is_taken_once(hovering: Replanner):
    measured = hovering.take_drift(0)
    assert measured is not None and measured[0].shift < 0.01
    assert measured[1] == pytest.approx(2.0 * OnboardConfig().lidar.sweep_period)
    assert hovering.take_drift(0) is None


def test_a_drift_from_before_a_reset_of_the_estimator_is_not_returned(hovering: Replanner):
    assert hovering.take_drift(1) is None


@pytest.mark.parametrize(
    ("std", "share"), [(math.nan, 1.0), (0.0, 1.0), (0.05, 1.0), (0.25, 1.0), (0.3, 0.8), (0.5, 0.5), (9.0, 0.5)]
)
def test_the_speed_falls_with_the_uncertainty_of_the_velocity(std: float, share: float):
    assert speed_share(std, 0.5) == pytest.approx(share)


def test_a_drone_whose_velocity_is_uncertain_flies_more_slowly(flight: Simulation, small_planner: Planner):
    limit = flight.planner.config.vehicle.speed_limit
    assert flight.run_until(lambda: flight.motion.speed > 0.8 * limit, 4.0)
    flight.link.velocity_std = 0.45
    flight.run(1.0)
    assert flight.motion.speed < 0.7 * limit and flight.node.state is State.FLYING
    flight.link.velocity_std = 0.05
    flight.run(0.2)
    assert small_planner.config.vehicle.speed_limit == limit
