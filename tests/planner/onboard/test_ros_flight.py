"""Flights of the node by the clouds of a driver and the odometry of FAST-LIO2, in simulated time."""

import functools
from typing import Any

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import DETECTION, Cause, State
from tests.planner.onboard.flight_checks import PERIOD, clearance, states
from tests.planner.onboard.ros_driver import RosLidar, RosLink
from tests.planner.onboard.simulated import GOAL, PLACES, WORLD, Simulation, in_flight


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


def switch(simulation: Simulation, name: str, value: Any) -> None:
    """Set an attribute of the simulation, such as "link.alive"."""
    *path, last = name.split(".")
    setattr(functools.reduce(getattr, path, simulation), last, value)


def nothing_in_view(points: np.ndarray) -> np.ndarray:
    return 0.0 * points


def unchanged(points: np.ndarray) -> np.ndarray:
    return points


LATENCY = 0.06
"""Time from a pose to the message with it, and to the next one [s]."""
FAULTS: dict[str, tuple[str, Any, Any, Cause]] = {
    "no odometry": ("link.odometry_alive", False, True, Cause.STATE_STALE),
    "an odometry that is not finite": ("link.lost", np.full(3, np.nan), np.zeros(3), Cause.STATE_STALE),
    "an uncertain odometry": ("link.variance", 9.0, 1e-4, Cause.ESTIMATE_POOR),
    "nothing from the autopilot": ("link.alive", False, True, Cause.FIX_LOST),
    "a late link": ("link.round_trip", 0.5, 0.02, Cause.LINK_LATE),
    "no fix": ("link.fix_age", 5.0, 0.1, Cause.FIX_LOST),
    "no transmitter": ("link.transmitter", False, True, Cause.TRANSMITTER_LOST),
    "no clouds": ("lidar.alive", False, True, Cause.CLOUD_STALE),
    "clouds of nothing": ("lidar.spoil", nothing_in_view, unchanged, Cause.CLOUD_STALE),
    "no plans": ("planning_alive", False, True, Cause.PLAN_STALE),
    "a stalled loop": ("control_alive", False, True, Cause.LOOP_STALLED),
}
"""What becomes wrong, how, and the cause by which the node brakes."""


@pytest.fixture
def flying(small_planner: Planner, monkeypatch: pytest.MonkeyPatch) -> Simulation:
    """A drone in full flight that is measured by ROS alone, whose position errs less than the fence is wide."""
    monkeypatch.setattr("tests.planner.onboard.simulated.SimulatedLink", RosLink)
    monkeypatch.setattr("tests.planner.onboard.simulated.SimulatedLidar", RosLidar)
    monkeypatch.setattr(RosLink, "period", 0.02)  # publish_freq as docs/onboard.md sets it
    flying = in_flight(small_planner, changes={"limits.hold_time": 1.0, "limits.fence_height_min": 0.5})
    assert states(flying) == ["READY", "FLYING"]
    return flying


@pytest.mark.parametrize("lasts", [False, True], ids=["for a while", "to the end"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_noticed_in_time_and_ends_well(flying: Simulation, fault: str, lasts: bool):
    name, broken, right, cause = FAULTS[fault]
    config, began = flying.node.config, flying.now
    count = len(flying.node.changes)
    within = sum(float(config.get(path)) for path in DETECTION[cause]) + LATENCY + PERIOD
    switch(flying, name, broken)
    flying.run(within + PERIOD)
    if cause is Cause.LOOP_STALLED:
        if lasts:  # the watchdog brakes in its place
            flying.run(config.limits.blind_time)
            assert flying.motion.speed < 1.0 and clearance(flying) > 0.0
            return
        switch(flying, name, right)
        # The watchdog brakes until there is a present velocity, from three positions.
        assert flying.run_until(lambda: len(flying.node.changes) > count, LATENCY + 4.0 * PERIOD)
    else:
        assert flying.node.changes[count].time - began <= within + PERIOD
    assert cause in [change.cause for change in flying.node.changes][count:]
    assert flying.node.state not in (State.FLYING, State.ARRIVED)
    if lasts:
        assert flying.run_until(lambda: flying.node.state is State.HANDED_BACK, 20.0)
        assert flying.motion.speed < 0.7 and clearance(flying) > 0.0
        return
    switch(flying, name, right)
    assert flying.run_until(lambda: flying.node.state is State.ARRIVED, 20.0) and clearance(flying) > 0.1


def test_when_the_odometry_is_lost_the_drone_brakes_and_is_handed_back(simulation: Simulation):
    assert simulation.run_until(lambda: simulation.motion.speed > 2.0, 5.0)
    assert isinstance(simulation.link, RosLink)
    simulation.link.lost = np.array([0.0, 9.0, 0.0])  # the autopilot knows better
    assert simulation.run_until(lambda: simulation.node.state is State.HANDED_BACK, 10.0)
    assert simulation.node.changes[-2].cause is Cause.STATE_STALE and simulation.motion.speed < 0.5
    assert clearance(simulation, PLACES) > 0.0
