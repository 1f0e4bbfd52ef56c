"""Faults in flight: of the LiDAR, the vehicle states, the planner, the fence and the pilot's mode."""

import dataclasses
import logging
import math

import numpy as np
import pytest

from aero_planner import Plan, Planner, PlanStatus
from aero_planner.onboard.failsafe_table import Reaction, State
from aero_planner.quaternions import rotate
from tests.planner.onboard.flight_checks import PERIOD, check_planned, clearance, since, states
from tests.planner.onboard.simulated import GOAL, WORLD, Simulation, in_flight


def test_a_dead_lidar_brakes_in_time_and_hands_back(flight: Simulation):
    limits, began = flight.node.config.limits, flight.now
    flight.lidar.alive = False
    flight.run(limits.cloud_age + 2 * PERIOD)
    assert flight.node.state is State.BRAKING
    assert since(flight, began, "BRAKING") <= limits.cloud_age + 2 * PERIOD
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)
    place = flight.motion.position
    flight.run(1.0)
    assert np.linalg.norm(flight.motion.position - place) < 0.3
    assert flight.run_until(lambda: flight.node.state is State.HANDED_BACK, 10.0)
    count = len(flight.link.sent)
    flight.run(1.0)
    assert len(flight.link.sent) == count and not flight.link.offboard and clearance(flight) > 0.0


@pytest.mark.parametrize(
    "spoil",
    [lambda points: points[:0], lambda points: 0.0 * points, lambda points: 1000.0 * points],
    ids=["no returns", "at the sensor", "in millimetres"],
)
def test_a_lidar_that_is_heard_and_sees_nothing_is_a_dead_one(flight: Simulation, spoil):
    limits, began = flight.node.config.limits, flight.now
    flight.lidar.spoil = spoil
    flight.run(limits.cloud_age + 2 * PERIOD)
    assert since(flight, began, "BRAKING") <= limits.cloud_age + 2 * PERIOD
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)
    flight.lidar.spoil = lambda points: points
    assert flight.run_until(lambda: flight.node.state is State.ARRIVED, 15.0) and clearance(flight) > 0.1


def test_with_a_stale_cloud_it_brakes_as_planned(flight: Simulation):
    flight.lidar.alive = False
    assert flight.run_until(lambda: flight.node.safety.reaction is Reaction.BRAKE_AS_PLANNED, 1.0)
    assert flight.node.state is State.BRAKING and flight.motion.speed > 2.0
    flight.planning_alive = False  # so that the schedule stays the same
    flight.run(3 * PERIOD)
    sent, command = flight.link.sent[-1]
    planned = flight.node.schedule.command(sent)
    assert planned is not None
    np.testing.assert_allclose(command, planned, atol=1e-6)
    flight.planning_alive = True
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)


def test_the_flight_continues_when_the_lidar_comes_back(flight: Simulation):
    flight.lidar.alive = False
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)
    flight.lidar.alive = True
    assert flight.run_until(lambda: flight.node.state is State.ARRIVED, 15.0)
    assert clearance(flight) > 0.1


@pytest.fixture
def ready(small_planner: Planner) -> Simulation:
    """An armed drone that the node is ready to fly, just after a heartbeat; the next one comes in a second."""
    simulation = Simulation(small_planner, WORLD, GOAL, changes={"limits.join_armed": True})
    simulation.link.heartbeat_period, simulation.link.armed = 1.0, True
    assert simulation.run_until(lambda: simulation.node.state is State.READY, 1.0)
    simulation.run(0.1)
    return simulation


@pytest.fixture
def switched(ready: Simulation) -> Simulation:
    """A drone at 4 m/s whose pilot switched to OFFBOARD 0.1 s ago, which the next heartbeat reports in 0.9 s."""
    ready.motion = dataclasses.replace(ready.motion, velocity=np.array([0.0, -4.0, 0.0]))
    ready.link.offboard = True
    ready.run(0.1)
    assert ready.node.state is State.READY
    return ready


def tilt(simulation: Simulation) -> float:
    """Return the angle between the drone's axis and the vertical [deg]."""
    up = rotate(simulation.motion.quaternion, np.array([0.0, 0.0, 1.0]))
    return math.degrees(math.acos(min(up[2], 1.0)))


def test_a_fault_before_the_switch_is_reported_stops_the_drone(switched: Simulation):
    switched.planner.spoil = lambda plan: dataclasses.replace(plan, controls=np.full_like(plan.controls, np.nan))
    switched.run(0.3)
    assert switched.node.state is State.WITHDRAWING and switched.link.offboard
    assert switched.run_until(lambda: switched.node.state is State.HOLDING, 3.0)
    assert switched.motion.speed < 0.5 and tilt(switched) < 10.0 and switched.link.offboard


def test_a_loop_that_stalls_before_the_switch_is_reported_is_replaced(switched: Simulation):
    switched.control_alive = False
    switched.run(switched.node.config.limits.deadline + switched.node.config.limits.blind_time + 0.1)
    np.testing.assert_allclose(switched.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0], atol=1e-9)
    assert switched.motion.speed < 1.0 and tilt(switched) < 10.0 and switched.link.offboard
    switched.control_alive = True
    switched.run(0.1)
    assert switched.node.state is State.WAITING  # the autopilot's failsafe has the drone


def test_a_node_that_withdraws_ends_with_a_level_hover(ready: Simulation):
    ready.lidar.alive = False
    assert ready.run_until(lambda: ready.node.state is State.WITHDRAWING, 0.7)
    assert ready.run_until(lambda: ready.node.state is State.WAITING, 1.1)
    np.testing.assert_allclose(ready.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0], atol=1e-9)
    count = len(ready.link.sent)
    ready.run(1.0)
    assert len(ready.link.sent) == count


@pytest.mark.parametrize("fault", ["frozen", "dead", "nan"])
def test_without_vehicle_states_it_levels_and_hands_back(flight: Simulation, fault: str):
    limits, began = flight.node.config.limits, flight.now
    if fault == "nan":
        flight.link.spoil = lambda state: dataclasses.replace(state, velocity=np.full(3, np.nan))
    else:
        setattr(flight.link, "frozen" if fault == "frozen" else "alive", fault == "frozen")
    stated = PERIOD if fault == "nan" else limits.state_age + PERIOD
    flight.run(stated + PERIOD)
    assert flight.node.state is State.BRAKING and since(flight, began, "BRAKING") <= stated + PERIOD
    flight.run(limits.state_age + limits.blind_time)
    assert flight.node.state is State.HANDED_BACK
    assert since(flight, began, "HANDED_BACK") <= limits.state_age + limits.blind_time + 2 * PERIOD
    # By dead reckoning alone it is almost at rest and level; the last command is to hover without turning.
    np.testing.assert_allclose(flight.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0], atol=1e-9)
    assert flight.motion.speed < 0.5
    count = len(flight.link.sent)
    flight.link.alive, flight.link.frozen, flight.link.spoil = True, False, lambda state: state
    flight.run(2.0)
    assert len(flight.link.sent) == count and flight.node.state is State.HANDED_BACK


def test_it_hands_back_level_however_little_time_it_has(small_planner: Planner):
    flight = in_flight(small_planner, changes={"limits.blind_time": 0.6})
    flight.link.frozen = True
    assert flight.run_until(lambda: flight.node.state is State.HANDED_BACK, 2.0)
    np.testing.assert_allclose(flight.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0], atol=1e-9)
    upright = rotate(flight.motion.quaternion, [0.0, 0.0, 1.0])[2]
    assert upright > math.cos(math.radians(3.0))


@pytest.mark.parametrize("lost", ["position", "velocity"])
def test_a_lost_position_brakes_at_once_and_hands_back(flight: Simulation, lost: str):
    limits, began = flight.node.config.limits, flight.now
    setattr(flight.link, f"{lost}_std", 3.0)
    flight.run(2 * PERIOD)
    assert flight.node.state is State.BRAKING and since(flight, began, "BRAKING") <= 2 * PERIOD
    flight.run(limits.brake_time)
    assert states(flight)[2:] == ["BRAKING", "HANDED_BACK"]  # it holds no position that it does not know
    np.testing.assert_allclose(flight.link.sent[-1][1], [9.81, 0.0, 0.0, 0.0], atol=1e-9)
    assert flight.motion.speed < 0.1 and clearance(flight) > 0.0


def test_a_short_gap_in_the_states_is_bridged(flight: Simulation):
    flight.link.alive = False
    flight.run(0.4)
    assert flight.node.state is State.BRAKING
    flight.link.alive = True
    flight.run(0.3)
    assert flight.node.state is State.FLYING


def test_a_planner_that_pauses_makes_it_brake_and_continue(flight: Simulation):
    began, flight.plan_time = flight.now, 0.5
    flight.run(0.6)
    # The newest plan may be based on a state up to 0.1 s old.
    assert since(flight, began, "BRAKING") <= flight.node.config.limits.plan_age + 2 * PERIOD
    flight.plan_time = 0.04
    assert flight.run_until(lambda: flight.node.state is State.ARRIVED, 15.0)
    assert clearance(flight) > 0.1


@pytest.mark.parametrize("late", [0.06, 0.1, 0.15])
def test_one_late_plan_changes_nothing(flight: Simulation, late: float):
    flight.plan_time = 0.005
    flight.run(0.3)
    flight.plan_time = late
    flight.run(0.9 * late)
    flight.plan_time = 0.005
    flight.run(1.0)
    assert states(flight) == ["READY", "FLYING"]


def test_a_planner_that_hangs_makes_it_brake_and_hand_back(flight: Simulation):
    began, flight.planning_alive = flight.now, False
    flight.run(flight.node.config.limits.plan_age + 2 * PERIOD)
    assert since(flight, began, "BRAKING") <= flight.node.config.limits.plan_age + 2 * PERIOD
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)
    assert flight.run_until(lambda: flight.node.state is State.HANDED_BACK, 16.0)
    assert clearance(flight) > 0.0


def test_a_plan_with_nan_is_never_flown(flight: Simulation, caplog: pytest.LogCaptureFixture):
    flight.planner.spoil = lambda plan: dataclasses.replace(plan, controls=np.full_like(plan.controls, np.nan))
    with caplog.at_level(logging.ERROR):
        flight.run(0.3)
    assert "BRAKING" in states(flight) and "the plan contains NaN or infinity" in caplog.text
    assert np.isfinite([command for _, command in flight.link.sent]).all()
    assert flight.node.statistics()["planner_failures"] >= 1
    flight.planner.spoil = lambda plan: plan
    flight.run(0.4)
    assert flight.node.state is State.FLYING


def test_a_planner_that_raises_makes_it_brake(flight: Simulation, caplog: pytest.LogCaptureFixture):
    def fail(plan: Plan) -> Plan:
        raise RuntimeError("CUDA error 700: an illegal memory access was encountered")

    flight.planner.spoil = fail
    with caplog.at_level(logging.ERROR):
        flight.run(0.6)
    assert flight.node.state in (State.BRAKING, State.HOLDING) and "CUDA error 700" in caplog.text


def test_without_a_safe_candidate_it_brakes_as_planned_and_waits(flight: Simulation):
    began = flight.now
    flight.planner.ageing = 1.0  # a stale cloud, for which the planner brakes as without a safe candidate
    check_planned(flight, 0.6)
    assert flight.node.state is State.BRAKING and since(flight, began, "BRAKING") < 0.2
    # The next plan starts from a state predicted along this one.
    assert flight.node.snapshot is not None and flight.node.snapshot.follows_plan
    assert flight.run_until(lambda: flight.node.state is State.HOLDING, 3.0)
    assert states(flight) == ["READY", "FLYING", "BRAKING", "HOLDING"]
    flight.planner.ageing = 0.0
    assert flight.run_until(lambda: flight.node.state is State.ARRIVED, 15.0)


def test_with_another_fault_it_does_not_brake_as_planned(flight: Simulation):
    turning = 1.0  # yaw rate, which the stop controller never commands

    def rate() -> float:
        assert flight.node.state is State.BRAKING
        return float(flight.link.sent[-1][1][3])

    flight.planner.spoil = lambda plan: dataclasses.replace(
        plan,
        status=PlanStatus.NO_SAFE_CANDIDATE,
        controls=np.broadcast_to([9.81, 0.0, 0.0, turning], np.shape(plan.controls)),
    )
    flight.plan_time = 0.0  # so that `run` ends exactly on time
    flight.run(0.3)
    assert rate() == turning
    flight.control_alive, count = False, len(flight.link.sent)
    flight.run(3 * PERIOD)
    assert rate() == turning and len(flight.link.sent) > count  # a late tick is bridged in this state, too
    flight.run(flight.node.config.limits.deadline - 2 * PERIOD)
    flight.control_alive = True
    flight.run(PERIOD)
    assert rate() == 0.0
    flight.run(PERIOD)
    assert rate() == turning
    flight.planning_alive = False
    flight.run(flight.node.config.limits.plan_age + PERIOD)
    assert rate() == 0.0


def test_the_fence_stops_the_drone(small_planner: Planner):
    """The path around the first pole leads out of the fence, which is very narrow."""
    fence = {"limits.fence_y_min": -0.3, "limits.fence_y_max": 0.3, "limits.hold_time": 1.0}
    simulation = Simulation(small_planner, WORLD, GOAL, changes=fence)
    simulation.engage()
    assert simulation.run_until(lambda: simulation.node.state is State.BRAKING, 5.0)
    assert str(simulation.node.changes[-1]).endswith("outside the geofence")
    assert 0.3 < abs(simulation.motion.position[1]) < 0.3 + 5.0 * 2 * PERIOD
    assert simulation.run_until(lambda: simulation.node.state is State.HANDED_BACK, 8.0)
    assert abs(simulation.motion.position[1]) < 2.0


def test_the_pilot_takes_over_at_any_time(flight: Simulation):
    began, flight.link.offboard = flight.now, False
    flight.run(0.2)
    # Silent at once; then ready for OFFBOARD again, with setpoints that would stop the drone.
    assert states(flight)[-2:] == ["WAITING", "READY"] and since(flight, began, "WAITING") <= PERIOD
    flight.link.offboard = True
    flight.run(0.1)
    assert flight.node.state is State.FLYING


def test_a_node_that_starts_in_the_air_stays_silent(small_planner: Planner):
    flight = in_flight(small_planner)
    again = Simulation(small_planner, WORLD, GOAL)
    again.motion, again.link.armed, again.link.offboard = (
        dataclasses.replace(flight.motion, time=again.now), True, True,
    )  # fmt: skip
    again.run(3.0)
    assert not again.link.sent and again.node.state is State.HANDED_BACK and not again.link.offboard
