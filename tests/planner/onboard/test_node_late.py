"""The watchdog in flight: a control loop that is late or hangs."""

import dataclasses
import logging
import math

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import State
from tests.planner.onboard.simulated import GOAL, SMALL, WORLD, Simulation

PERIOD = 0.02
STALLED = "FLYING -> BRAKING: the control loop stalled"
"""A drone that the watchdog has almost stopped is HOLDING a moment later."""


def test_the_watchdog_brakes_when_the_control_loop_hangs(flight: Simulation, caplog: pytest.LogCaptureFixture):
    limits, began, count = flight.node.config.limits, flight.now, len(flight.link.sent)
    flight.control_alive = False
    with caplog.at_level(logging.ERROR):
        flight.run(limits.deadline + 2 * PERIOD)
    assert len(flight.link.sent) > count and flight.link.sent[count][0] - began <= limits.deadline + 2 * PERIOD
    assert "the control loop has stalled" in caplog.text
    flight.run(limits.blind_time)
    assert flight.motion.speed < 1.0  # by dead reckoning alone
    count = len(flight.link.sent)
    flight.run(0.3)
    assert len(flight.link.sent) == count  # the autopilot's failsafe acts now
    assert flight.node.statistics()["watchdog_interventions"] == 1


def test_a_late_tick_is_bridged_with_planned_commands(flight: Simulation):
    schedule, limits = flight.node.schedule, flight.node.config.limits
    flight.planning_alive = False
    flight.run(2 * PERIOD)
    count, began = len(flight.link.sent), flight.link.sent[-1][0]
    flight.control_alive = False
    flight.run(limits.deadline - PERIOD)
    bridging = flight.link.sent[count:]
    # The first bridging command comes one period late, after waiting for the tick.
    np.testing.assert_allclose([now - began for now, _ in bridging], PERIOD * np.arange(2, 2 + len(bridging)))
    assert len(bridging) >= 2
    for k, (_, command) in enumerate(bridging, start=2):
        planned = schedule.command(began + k * PERIOD)
        assert planned is not None
        planned[0] = min(planned[0], SMALL.vehicle.thrust_max)  # the planner's limit is a float32
        np.testing.assert_array_equal(command, planned)
    assert flight.node.statistics()["watchdog_interventions"] == 0
    flight.control_alive = flight.planning_alive = True
    flight.run(3 * PERIOD)
    assert flight.node.state is State.FLYING


def test_a_late_tick_is_bridged_within_the_vehicles_bounds(flight: Simulation):
    vehicle = flight.planner.config.vehicle
    most = [vehicle.thrust_max, vehicle.rate_xy_max, vehicle.rate_xy_max, vehicle.rate_z_max]
    flight.planner.spoil = lambda plan: dataclasses.replace(plan, controls=np.full_like(plan.controls, 1000.0))
    flight.run(0.2)
    count = len(flight.link.sent)
    flight.control_alive = False
    flight.run(3 * PERIOD)
    assert len(flight.link.sent) > count
    np.testing.assert_array_equal([command for _, command in flight.link.sent[count - 1 :]][-1], most)


def test_upcoming_commands_end_where_the_plan_is_too_old(flight: Simulation):
    schedule, limits = flight.node.schedule, flight.node.config.limits
    newest = schedule.at(flight.now)
    assert newest is not None
    left = newest.measured + limits.plan_age - flight.now
    upcoming = schedule.upcoming(flight.now, period=PERIOD, count=100, age_max=limits.plan_age)
    assert len(upcoming) == math.floor(left / PERIOD + 1e-9)
    np.testing.assert_array_equal(upcoming[2], schedule.command(flight.now + 3 * PERIOD))


def test_a_control_loop_that_comes_back_brakes_first_and_continues(flight: Simulation):
    flight.control_alive = False
    flight.run(0.4)
    flight.control_alive = True
    flight.run(PERIOD)
    assert STALLED in map(str, flight.node.changes)
    flight.run(0.5)
    assert flight.node.state is State.FLYING


def test_a_control_loop_that_comes_back_waits_for_a_present_state_while_the_watchdog_brakes(flight: Simulation):
    flight.control_alive, flight.link.frozen = False, True
    flight.run(0.5)
    flight.control_alive, count = True, len(flight.link.sent)
    flight.run(5 * PERIOD)
    assert len(flight.link.sent) == count + 5 and flight.node.state is State.FLYING
    flight.link.frozen = False
    flight.run(PERIOD)
    assert STALLED in map(str, flight.node.changes)


def test_a_control_loop_that_comes_back_without_any_state_hands_back_in_time(flight: Simulation):
    flight.control_alive, flight.link.frozen = False, True
    flight.run(0.5)
    flight.control_alive = True
    flight.run(flight.node.config.limits.deadline + flight.node.config.limits.blind_time)
    # The last command is that of the watchdog, which the loop has waited for.
    assert flight.node.state is State.HANDED_BACK
    np.testing.assert_allclose(flight.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0])


def test_a_control_loop_that_comes_back_too_late_stays_silent(flight: Simulation):
    flight.control_alive = False
    flight.run(flight.node.config.limits.deadline + flight.node.config.limits.blind_time + 0.1)
    count = len(flight.link.sent)
    np.testing.assert_allclose(flight.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0])
    flight.run(1.0)
    assert not flight.link.offboard  # the autopilot has taken control
    flight.control_alive = True
    flight.run(3.0)
    assert flight.node.state is State.HANDED_BACK and len(flight.link.sent) == count


def test_the_watchdog_is_silent_while_the_pilot_flies(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL)
    simulation.run(0.5)
    assert simulation.node.state is State.READY
    simulation.control_alive = False
    count = len(simulation.link.sent)
    simulation.run(1.0)
    assert len(simulation.link.sent) == count
