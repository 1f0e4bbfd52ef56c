"""Flights of the node by the clouds of a driver and the odometry of FAST-LIO2, in simulated time."""

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import Cause, State
from tests.planner.onboard.flight_checks import clearance, states
from tests.planner.onboard.ros_driver import RosLidar, RosLink
from tests.planner.onboard.simulated import GOAL, PLACES, WORLD, Simulation


@pytest.fixture
def simulation(small_planner: Planner, monkeypatch: pytest.MonkeyPatch) -> Simulation:
    """A drone that is measured by ROS alone, and flies."""
    monkeypatch.setattr("tests.planner.onboard.simulated.SimulatedLink", RosLink)
    monkeypatch.setattr("tests.planner.onboard.simulated.SimulatedLidar", RosLidar)
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.run(0.5)
    simulation.engage()
    return simulation


def test_a_flight_from_start_to_goal(simulation: Simulation):
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 20.0)
    simulation.run(3.0)
    assert np.linalg.norm(simulation.motion.position - GOAL) < 1.0 and simulation.motion.speed < 0.3
    assert clearance(simulation, PLACES) > 0.15 and states(simulation) == ["READY", "FLYING", "ARRIVED"]
    link, lidar = simulation.link, simulation.lidar
    assert isinstance(link, RosLink) and isinstance(lidar, RosLidar)
    assert lidar.driver.counters.bad == 0 and not link.odometry.dropped


def test_when_the_odometry_is_lost_the_drone_brakes_and_is_handed_back(simulation: Simulation):
    assert simulation.run_until(lambda: simulation.motion.speed > 2.0, 5.0)
    assert isinstance(simulation.link, RosLink)
    simulation.link.lost = np.array([0.0, 9.0, 0.0])  # the autopilot knows better
    assert simulation.run_until(lambda: simulation.node.state is State.HANDED_BACK, 10.0)
    assert simulation.node.changes[-2].cause is Cause.STATE_STALE and simulation.motion.speed < 0.5
    assert clearance(simulation, PLACES) > 0.0
