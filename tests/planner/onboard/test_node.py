"""Flights of the node without faults: goals, the ground, and when it is ready."""

import dataclasses
import logging
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner import Planner, VehicleState
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.ground_tracker import GroundSource
from tests.planner.onboard.conftest import Records
from tests.planner.onboard.flight_checks import PERIOD, check_planned, clearance, states
from tests.planner.onboard.simulated import GOAL, PLACES, WORLD, Simulation, in_flight


def test_a_flight_from_start_to_goal(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.run(0.5)
    assert simulation.node.state is State.READY
    before = [command for _, command in simulation.link.sent]
    # The setpoints that PX4 requires before OFFBOARD would keep the drone in place.
    np.testing.assert_allclose(before, np.tile([9.81, 0.0, 0.0, 0.0], (len(before), 1)), atol=1e-6)
    simulation.engage()
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 15.0)
    simulation.run(3.0)
    assert np.linalg.norm(simulation.motion.position - GOAL) < 1.0 and simulation.motion.speed < 0.1
    assert clearance(simulation, PLACES) > 0.2
    assert states(simulation) == ["READY", "FLYING", "ARRIVED"]
    gaps = np.diff([when for when, _ in simulation.link.sent])
    np.testing.assert_allclose(gaps, PERIOD, atol=1e-6)


def test_each_command_is_the_planned_control_of_its_time(flight: Simulation):
    check_planned(flight, 0.5)


def test_plans_start_where_the_drone_will_be(small_planner: Planner):
    seen = Records()
    simulation = in_flight(small_planner, plan_time=0.06, state_delay=0.0, observers=[seen])
    del seen.plans[:-1]
    truth: dict[float, NDArray[np.float64]] = {}
    for _ in range(60):
        simulation.run(0.005)
        truth[simulation.now] = simulation.motion.position
    times = np.array(list(truth))
    errors = []
    for state in (record.state for record in seen.plans):
        nearest = int(np.abs(times - float(state.time)).argmin())  # type: ignore[arg-type]
        if abs(times[nearest] - float(state.time)) < 0.004:  # type: ignore[arg-type]
            errors.append(np.linalg.norm(np.asarray(state.position) - truth[times[nearest]]))
    # Without prediction the error would be 60 ms of flight, more than 0.1 m.
    assert len(errors) >= 3 and max(errors) < 0.05


def test_without_goal_or_points_it_waits_in_silence(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, None)
    simulation.run(1.0)
    assert simulation.node.state is State.WAITING and not simulation.link.sent
    simulation.link.goal = np.array(GOAL)
    simulation.run(0.3)
    assert simulation.node.state is State.READY
    np.testing.assert_array_equal(simulation.node.goal, GOAL)
    simulation.lidar.alive = False
    simulation.run(1.0)
    assert simulation.node.state is State.WAITING


def test_on_the_ground_it_waits_and_says_why(small_planner: Planner, caplog: pytest.LogCaptureFixture):
    """Whatever the estimated height: the drone in the simulation is at 2 m."""
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.link.in_air = None
    with caplog.at_level(logging.INFO):
        simulation.run(2.0)
        assert "not READY: the autopilot does not report whether the vehicle is in the air" in caplog.text
        simulation.link.in_air, simulation.link.armed = False, True
        simulation.run(2.0)
    assert caplog.text.count("not READY: the vehicle is on the ground, taking off or landing") == 1
    simulation.link.offboard = True
    simulation.run(2.0)
    assert states(simulation) == [] and not simulation.link.sent
    simulation.link.offboard, simulation.link.in_air = False, True
    simulation.run(0.1)
    assert simulation.node.state is State.READY


def test_a_goal_below_the_ground_that_is_found_in_flight_is_not_flown_to(
    small_planner: Planner, caplog: pytest.LogCaptureFixture
):
    simulation = Simulation(small_planner, WORLD, (18.0, 0.0, 1.5), changes={"limits.fence_height_min": -0.5})
    simulation.engage()
    simulation.run(0.5)
    assert simulation.node.state is State.FLYING
    for k in range(10):  # measured anew each time
        simulation.link.ground_height = 2.1 + 0.001 * (k % 2)
        simulation.run(0.1)
    assert simulation.node.goal is None and simulation.node.state is State.BRAKING
    assert "no plan in time" in str(simulation.node.changes[-1])
    assert "is refused: it lies outside the geofence, at -0.60 instead of -0.5 to 30 m above the ground" in caplog.text


def test_the_planner_treats_the_bottom_of_the_fence_as_ground(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL, changes={"limits.fence_height_min": 0.7})
    simulation.run(0.3)
    assert simulation.node.state is State.READY and simulation.planner.options["ground_height"] == 0.7


def test_the_floor_lies_above_the_ground_that_the_distance_sensor_sees(small_planner: Planner):
    """The autopilot's height is 0.6 m too large: by it alone, the drone would be 0.4 m above the floor of the fence."""
    simulation = Simulation(small_planner, WORLD, (18.0, 0.0, 3.0), changes={"limits.fence_height_min": 1.6})
    raised = np.array([0.0, 0.0, 0.6])
    simulation.link.spoil = lambda state: dataclasses.replace(state, position=np.asarray(state.position) + raised)
    simulation.motion = dataclasses.replace(simulation.motion, position=np.array([0.0, 0.0, 1.5]))
    simulation.run(0.3)
    assert simulation.node.state is State.READY
    simulation.link.ground_height = 0.6
    for k in range(10):  # measured anew each time
        simulation.link.ground_height = 0.6 + 0.001 * (k % 2)
        simulation.run(0.1)
    assert simulation.node.state is State.WAITING and Cause.BELOW_FLOOR in simulation.node.safety.missing()
    assert simulation.planner.options["ground_height"] == pytest.approx(2.2, abs=0.01)
    assert simulation.node.statistics()["ground_source"] == "RANGE"
    simulation.motion = dataclasses.replace(simulation.motion, position=np.array([0.0, 0.0, 1.7]))
    simulation.run(0.2)
    assert simulation.node.state is State.READY


def test_with_an_estimate_that_drifts_it_is_not_ready(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.run(3.0)
    assert simulation.node.state is State.READY
    began = simulation.now

    def drift(state: VehicleState) -> VehicleState:
        offset = np.array([0.0, 0.5, 0.0]) * (simulation.now - began)
        return dataclasses.replace(state, position=np.asarray(state.position) + offset)

    simulation.link.spoil = drift
    simulation.run(3.0)
    assert simulation.node.state is State.WAITING
    assert simulation.node.safety.missing() == (Cause.CLOUD_DRIFTS,)
    simulation.link.spoil = lambda state: state
    simulation.link.resets += 1
    simulation.run(5.0)
    assert simulation.node.state is State.READY


def test_the_ground_is_where_the_drone_stood(small_planner: Planner):
    """PX4's height read 0.48 m on the ground."""
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.link.in_air = False
    simulation.motion = dataclasses.replace(simulation.motion, position=np.array([0.0, 0.0, 0.48]))
    simulation.run(0.5)
    assert simulation.node.ground.height == pytest.approx(0.48)
    simulation.link.armed = simulation.link.in_air = True
    for height, state in ((1.4, State.WAITING), (1.5, State.READY)):
        simulation.motion = dataclasses.replace(simulation.motion, position=np.array([0.0, 0.0, height]))
        simulation.run(0.2)
        assert simulation.node.state is state
    simulation.link.resets += 1  # the origin has moved
    simulation.run(0.1)
    assert simulation.node.ground.source is GroundSource.ASSUMED


def test_a_goal_over_the_link_replaces_the_first(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, (2.5, 0.0, 2.0))
    simulation.engage()
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 8.0)
    simulation.link.goal = np.array([2.5, 3.0, 2.0])
    assert simulation.run_until(lambda: simulation.node.state is State.FLYING, 1.0)
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 8.0)
    assert np.linalg.norm(simulation.motion.position - [2.5, 3.0, 2.0]) < 1.0


def test_a_new_goal_near_the_reached_one_is_flown_to(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, (2.5, 0.0, 2.0))
    simulation.engage()
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 8.0)
    simulation.run(1.0)
    # Less than two arrival radii away, which could also be drift.
    goal = simulation.link.goal = simulation.motion.position + np.array([0.0, 0.9, 0.0])
    simulation.run(4.0)
    assert states(simulation) == ["READY", "FLYING", "ARRIVED", "FLYING", "ARRIVED"]
    assert np.linalg.norm(simulation.motion.position - goal) < 0.9


def test_it_holds_its_position_in_wind(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, (2.5, 0.0, 2.0))
    simulation.engage()
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 8.0)
    assert simulation.run_until(lambda: simulation.motion.speed < 0.1, 3.0)
    place, simulation.wind = simulation.motion.position, np.array([0.0, 0.3, 0.0])
    simulation.run(6.0)
    # The offset balances the wind: 0.3 m/s^2 over brake.position_gain.
    assert simulation.node.state is State.ARRIVED and simulation.motion.speed < 0.05
    assert 0.1 < np.linalg.norm(simulation.motion.position - place) < 0.3


def test_a_goal_outside_the_fence_is_refused(small_planner: Planner, caplog: pytest.LogCaptureFixture):
    simulation = Simulation(small_planner, WORLD, GOAL)
    for goal in ((500.0, 0.0, 2.0), (5.0, 0.0, 0.0), (math.nan, 0.0, 2.0)):
        simulation.link.goal = np.array(goal)
        simulation.run(0.1)
    np.testing.assert_array_equal(simulation.node.goal, GOAL)
    assert caplog.text.count("is refused: it lies outside the geofence") == 3
