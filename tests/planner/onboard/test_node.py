import dataclasses
import logging
import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner import Plan, Planner, PlanStatus, VehicleState
from aero_planner.onboard.failsafe_table import Cause, Reaction, State
from aero_planner.onboard.ground_tracker import GroundSource
from aero_planner.onboard.plan_schedule import ScheduledPlan
from aero_planner.quaternions import rotate
from tests.planner.onboard.conftest import Records
from tests.planner.onboard.simulated import CORRIDOR, GOAL, PLACES, WORLD, Simulation, in_flight

PERIOD = 0.02


def states(simulation: Simulation) -> list[str]:
    return [change.target.name for change in simulation.node.changes]


def since(simulation: Simulation, began: float, name: str) -> float:
    """Return the time from `began` until the state `name` was entered [s]."""
    changes = [change.time for change in simulation.node.changes if change.target.name == name]
    return next(time for time in changes if time >= began) - began


def clearance(simulation: Simulation, places: Sequence[tuple[float, float]] = CORRIDOR) -> float:
    path = np.array(simulation.path)[:, None, :2]
    return float(np.linalg.norm(path - np.array(places), axis=2).min()) - 0.25


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


def check_planned(flight: Simulation, seconds: float) -> None:
    """Fly for some time and check that each command is the planned control of its time."""
    plans: list[tuple[float, ScheduledPlan]] = []
    schedule = flight.node.schedule
    append = schedule.append

    def keep(plan: ScheduledPlan, now: float) -> None:
        plans.append((flight.now, plan))
        append(plan, now)

    schedule.append = keep  # type: ignore[method-assign]
    first = len(flight.link.sent)
    flight.run(seconds)
    checked = 0
    for now, command in flight.link.sent[first:]:
        begun = [plan for there, plan in plans if plan.time <= now and there < now]
        if not begun:
            continue
        plan = begun[-1]
        planned = plan.controls[math.floor((now - plan.time) / plan.dt + 1e-9)]
        np.testing.assert_allclose(command, planned)
        assert 0.0 <= now - plan.measured <= flight.node.config.limits.plan_age
        checked += 1
    assert checked >= 0.8 * seconds / PERIOD
    schedule.append = append  # type: ignore[method-assign]


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


def test_the_planner_treats_the_bottom_of_the_fence_as_ground(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL, changes={"limits.fence_height_min": 0.7})
    simulation.run(0.3)
    assert simulation.node.state is State.READY and simulation.planner.options["ground_height"] == 0.7


def test_the_floor_lies_above_the_ground_that_the_distance_sensor_sees(small_planner: Planner):
    """The autopilot's height is 0.6 m too large: by it alone, the drone would be 0.4 m above the floor of the fence."""
    simulation = Simulation(small_planner, WORLD, GOAL, changes={"limits.fence_height_min": 1.6})
    raised = np.array([0.0, 0.0, 0.6])
    simulation.link.spoil = lambda state: dataclasses.replace(state, position=np.asarray(state.position) + raised)
    simulation.motion = dataclasses.replace(simulation.motion, position=np.array([0.0, 0.0, 1.5]))
    simulation.run(0.3)
    assert simulation.node.state is State.READY
    simulation.link.ground_height = 0.6
    for k in range(10):  # measured anew each time
        simulation.link.ground_height = 0.6 + 0.001 * (k % 2)
        simulation.run(0.1)
    assert simulation.node.state is State.WAITING and Cause.OUTSIDE_FENCE in simulation.node.safety.missing()
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


# --- faults ---


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
