"""The safety machine over time: random faults, and flights step by step."""

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlanStatus
from aero_planner.onboard.failsafe_table import (
    AS_PLANNED,
    DETECTION,
    Cause,
    Inputs,
    Reaction,
    State,
)
from aero_planner.onboard.safety_machine import SafetyMachine
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.safety_inputs import LIMITS, WELL, check_one_step

PERIOD = 0.02
SOURCES: tuple[str, ...] = (
    "link", "state", "estimate", "drift", "cloud", "plan", "fence", "status", "nan state", "nan plan", "overrun",
    "failsafe", "landed", "landed state",
)  # fmt: skip
"""Faults, and what else prevents READY, that last for a while."""
CAUSES = {
    "drift": Cause.CLOUD_DRIFTS, "link": Cause.LINK_LOST, "state": Cause.STATE_STALE, "estimate": Cause.ESTIMATE_POOR,
    "cloud": Cause.CLOUD_STALE, "plan": Cause.PLAN_STALE,
    "fence": Cause.OUTSIDE_FENCE, "status": Cause.PLAN_UNSAFE, "nan state": Cause.STATE_NOT_FINITE,
    "nan plan": Cause.PLAN_NOT_FINITE, "overrun": Cause.LOOP_STALLED,
}  # fmt: skip
PILOT_FLIES = dataclasses.replace(WELL, offboard=False)
segments = st.lists(
    st.tuples(
        st.floats(0.02, 6.0),
        st.frozensets(st.sampled_from(SOURCES), max_size=3),
        st.sampled_from(("offboard", "offboard", "offboard", "armed", "disarmed")),
        st.floats(0.0, 8.0),
    ),
    min_size=1,
    max_size=6,
)


class World:
    """A vehicle and its pilot over time, as the machine sees them."""

    def __init__(self) -> None:
        self.now = 0.0
        self.safety = SafetyMachine(LIMITS)
        self.fresh: dict[str, float] = dict.fromkeys(SOURCES, 0.0)
        """Time at which each fault was last absent."""

    def step(self, broken: frozenset[str], mode: str, speed: float) -> Reaction:
        self.now += PERIOD
        for name in SOURCES:
            if name not in broken:
                self.fresh[name] = self.now
        age = {name: self.now - time for name, time in self.fresh.items()}
        return self.safety.step(
            self.now,
            dataclasses.replace(
                WELL,
                armed=mode != "disarmed",
                offboard=mode == "offboard",
                heartbeat_age=age["link"],
                state_age=max(age["state"], age["nan state"]),
                cloud_age=age["cloud"],
                plan_age=max(age["plan"], age["nan plan"]),
                plan_status=PlanStatus.NO_SAFE_CANDIDATE if "status" in broken else PlanStatus.OK,
                state_finite="nan state" not in broken,
                plan_finite="nan plan" not in broken,
                position_std=5.0 if "estimate" in broken else 0.2,
                drift_speed=0.5 if "drift" in broken else 0.1,
                guarded="failsafe" not in broken,
                in_air=None if "landed state" in broken else "landed" not in broken,
                inside_fence="fence" not in broken,
                loop_age=LIMITS.deadline + 0.01 if "overrun" in broken else PERIOD,
                speed=speed,
            ),
        )

    def broken_for(self, name: str) -> float:
        return self.now - self.fresh[name]


@settings(max_examples=150, deadline=None)
@given(segments)
def test_reactions_to_random_faults_come_in_time(plan: list[tuple[float, frozenset[str], str, float]]):
    world = World()
    for _ in range(5):
        world.step(frozenset(), "disarmed", 0.0)
    for _ in range(5):
        world.step(frozenset(), "armed", 0.0)
    assert world.step(frozenset(), "offboard", 0.0) is Reaction.STREAM_PLAN
    config = OnboardConfig()
    since_well = 0.0
    for duration, broken, mode, speed in plan:
        for _ in range(round(duration / PERIOD)):
            before = world.safety.state
            reaction = world.step(broken, mode, speed)
            assert world.safety.inputs is not None
            check_one_step(before, world.safety.inputs, world.safety.state)
            for name in broken & CAUSES.keys():
                stated = sum(float(config.get(path)) for path in DETECTION[CAUSES[name]])
                if world.broken_for(name) > stated + PERIOD:
                    assert reaction not in AS_PLANNED or (
                        name in ("status", "cloud") and reaction is Reaction.BRAKE_AS_PLANNED
                    ), name
            blind = max(world.broken_for("state"), world.broken_for("nan state"))
            if blind > LIMITS.state_age + LIMITS.blind_time + 2 * PERIOD:
                assert reaction is Reaction.SILENT
            is_well = world.safety.state in (State.READY, State.FLYING, State.ARRIVED)
            since_well = 0.0 if is_well else since_well + PERIOD
            # A drone that was at rest may have to brake once more.
            if since_well > 2.0 * LIMITS.brake_time + LIMITS.hold_time + 3 * PERIOD and mode == "offboard":
                assert reaction is Reaction.SILENT


def run(safety: SafetyMachine, inputs: Inputs, seconds: float, start: float) -> float:
    for _ in range(round(seconds / PERIOD)):
        start += PERIOD
        safety.step(start, inputs)
    return start


def started(inputs: Inputs, state: State) -> tuple[SafetyMachine, float]:
    """Return a machine that `inputs` have brought from a disarmed vehicle to `state`, and the time then."""
    safety = SafetyMachine(LIMITS)
    now = run(safety, dataclasses.replace(WELL, armed=False, offboard=False), 0.1, 0.0)
    now = run(safety, inputs, 0.1, now)
    assert safety.state is state
    return safety, now


def flying() -> tuple[SafetyMachine, float]:
    return started(WELL, State.FLYING)


def ready() -> tuple[SafetyMachine, float]:
    return started(PILOT_FLIES, State.READY)


def test_a_flight_from_the_ground_to_the_goal_and_back_to_the_pilot():
    changes = []
    safety = SafetyMachine(LIMITS, on_change=changes.append)
    ground = dataclasses.replace(WELL, armed=False, offboard=False)
    now = run(safety, dataclasses.replace(ground, inside_fence=False), 0.1, 0.0)
    assert safety.state is State.WAITING and safety.active_faults() == (Cause.OUTSIDE_FENCE,)
    now = run(safety, dataclasses.replace(ground, armed=True), 0.1, now)
    assert safety.state is State.READY and safety.reaction is Reaction.BRAKE
    now = run(safety, WELL, 0.1, now)
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.3), 60.0, now)
    assert safety.state is State.ARRIVED and safety.reaction is Reaction.HOLD
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.8), 0.1, now)
    assert safety.state is State.ARRIVED  # a small drift is not a new goal
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.8, goal_number=1), 0.1, now)
    assert safety.state is State.FLYING  # this is a new goal
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.4, goal_number=1), 0.1, now)
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.8, goal_number=1), 0.1, now)
    assert safety.state is State.ARRIVED
    now = run(safety, dataclasses.replace(WELL, goal_distance=0.4, goal_number=2), 0.1, now)
    assert safety.state is State.ARRIVED  # the drone is already at this goal
    now = run(safety, WELL, 0.1, now)
    assert safety.state is State.FLYING
    run(safety, dataclasses.replace(WELL, offboard=False), 0.02, now)
    assert [change.target.name for change in changes] == [
        "READY", "FLYING", "ARRIVED", "FLYING", "ARRIVED", "FLYING", "WAITING",
    ]  # fmt: skip
    assert str(changes[-1]) == "FLYING -> WAITING: the vehicle was disarmed or left OFFBOARD"


def test_a_drone_on_the_ground_is_never_ready():
    safety = SafetyMachine(LIMITS)
    ground = dataclasses.replace(WELL, armed=False, offboard=False, in_air=False)
    now = run(safety, ground, 1.0, 0.0)
    assert safety.state is State.WAITING and safety.missing() == (Cause.ON_GROUND,)
    now = run(safety, dataclasses.replace(ground, armed=True, in_air=None), 1.0, now)
    assert safety.state is State.WAITING and safety.missing() == (Cause.IN_AIR_UNKNOWN,)
    now = run(safety, dataclasses.replace(WELL, in_air=False), 1.0, now)
    assert safety.state is State.WAITING and safety.reaction is Reaction.SILENT  # in OFFBOARD, on the ground
    now = run(safety, dataclasses.replace(WELL, offboard=False), 0.1, now)
    assert safety.state is State.READY and safety.missing() == ()
    now = run(safety, dataclasses.replace(WELL, offboard=False, in_air=False), 0.02, now)
    assert safety.state is State.WAITING


def test_a_cloud_that_drifts_prevents_a_take_over_and_brakes_a_flight():
    drifting = dataclasses.replace(WELL, drift_speed=LIMITS.drift_speed + 0.01)
    safety = SafetyMachine(LIMITS)
    now = run(safety, dataclasses.replace(drifting, armed=False, offboard=False), 0.1, 0.0)
    assert safety.state is State.WAITING and safety.missing() == (Cause.CLOUD_DRIFTS,)
    safety, now = flying()
    now = run(safety, drifting, PERIOD, now)
    assert safety.state is State.BRAKING and safety.reaction is Reaction.BRAKE
    # The speed is unknown, too, so that it is not at rest.
    now = run(safety, dataclasses.replace(drifting, speed=0.0), 0.5, now)
    now = run(safety, dataclasses.replace(WELL, drift_speed=0.8 * LIMITS.drift_speed), 0.5, now)
    assert safety.state is State.BRAKING
    now = run(safety, dataclasses.replace(WELL, drift_speed=0.6 * LIMITS.drift_speed), PERIOD, now)
    assert safety.state is State.FLYING
    run(safety, dataclasses.replace(WELL, drift_angle=math.radians(LIMITS.drift_angle) + 0.01), 5.2, now)
    assert safety.state is State.HANDED_BACK


def test_a_node_without_its_failsafe_process_is_never_ready_and_flies_on():
    unguarded = dataclasses.replace(WELL, guarded=False)
    safety = SafetyMachine(LIMITS)
    run(safety, dataclasses.replace(unguarded, armed=False, offboard=False), 0.1, 0.0)
    assert safety.state is State.WAITING and safety.missing() == (Cause.UNGUARDED,)
    safety, now = flying()
    run(safety, unguarded, 1.0, now)
    assert safety.state is State.FLYING


@pytest.mark.parametrize("missing", [{"guarded": False}, {"in_air": None}, {"in_air": False}])
@pytest.mark.parametrize("at_rest", [False, True])
@pytest.mark.parametrize("arrived", [False, True])
def test_what_prevents_ready_prevents_the_way_back_to_flying(missing: dict, at_rest: bool, arrived: bool):
    lacking = dataclasses.replace(WELL, **missing)
    safety, now = flying()
    if arrived:
        now = run(safety, dataclasses.replace(WELL, goal_distance=0.1), 0.1, now)
        now = run(safety, dataclasses.replace(lacking, goal_number=1), 5.0, now)
        assert safety.state is State.ARRIVED
        run(safety, dataclasses.replace(WELL, goal_number=1), PERIOD, now)
        assert safety.state is State.FLYING
        return
    speed = 0.1 if at_rest else 3.0
    now = run(safety, dataclasses.replace(WELL, cloud_age=math.inf, speed=speed), 0.5, now)
    now = run(safety, dataclasses.replace(lacking, speed=speed), 1.0, now)
    assert safety.state is (State.HOLDING if at_rest else State.BRAKING)
    assert set(safety.missing()) & {Cause.UNGUARDED, Cause.IN_AIR_UNKNOWN, Cause.ON_GROUND}
    run(safety, WELL, PERIOD, now)
    assert safety.state is State.FLYING


@pytest.mark.parametrize(("bad", "good"), [(0.5, 0.5), (1.0, 0.2), (0.4, 1.0), (0.04, 0.02), (3.0, 4.0)])
@pytest.mark.parametrize("cause", [{"cloud_age": math.inf}, {"inside_fence": False}, {"drift_speed": 0.5}])
def test_alternating_flying_and_braking_ends(bad: float, good: float, cause: dict):
    safety, now = flying()
    start = now
    while now - start < 150.0 and safety.state is not State.HANDED_BACK:
        # A drone that brakes for a second has stopped.
        now = run(safety, dataclasses.replace(WELL, **cause), min(bad, 1.0), now)
        now = run(safety, dataclasses.replace(WELL, **cause, speed=0.1), max(bad - 1.0, 0.0), now)
        at_rest = safety.state is State.HOLDING
        now = run(safety, dataclasses.replace(WELL, speed=0.1 if at_rest else 3.0), good, now)
    assert safety.state is State.HANDED_BACK


def test_rare_faults_do_not_end_a_long_flight():
    safety, now = flying()
    for _ in range(200):
        now = run(safety, dataclasses.replace(WELL, plan_status=PlanStatus.NO_SAFE_CANDIDATE), 0.1, now)
        now = run(safety, WELL, 0.9, now)
        assert safety.state is State.FLYING


def test_after_a_fault_in_ready_the_next_heartbeat_decides():
    blind = dataclasses.replace(PILOT_FLIES, cloud_age=math.inf)
    safety, now = ready()
    now = run(safety, blind, 0.4, now)
    assert safety.state is State.WITHDRAWING and safety.reaction is Reaction.BRAKE
    run(safety, dataclasses.replace(blind, heartbeat_age=0.0), PERIOD, now)
    assert safety.state is State.WAITING and safety.reaction is Reaction.SILENT

    safety, now = ready()
    now = run(safety, blind, 0.4, now)
    now = run(safety, dataclasses.replace(blind, offboard=True, heartbeat_age=0.0), PERIOD, now)
    assert safety.state is State.BRAKING
    run(safety, WELL, PERIOD, now)
    assert safety.state is State.FLYING  # as the pilot has asked for

    safety, now = ready()
    now = run(safety, blind, 0.4, now)
    run(safety, PILOT_FLIES, PERIOD, now)
    assert safety.state is State.READY

    safety, now = ready()
    run(safety, dataclasses.replace(blind, heartbeat_age=math.inf), 0.1, now)
    assert safety.state is State.WAITING  # without heartbeats for too long


def test_a_drone_that_lands_is_left_alone_at_once():
    for last in (PILOT_FLIES, dataclasses.replace(PILOT_FLIES, cloud_age=math.inf)):
        safety, now = ready()
        now = run(safety, last, 0.1, now)
        run(safety, dataclasses.replace(last, in_air=False), PERIOD, now)
        assert safety.state is State.WAITING


def test_a_landed_state_does_not_disturb_a_flight():
    safety, now = flying()
    for in_air in (False, None):
        now = run(safety, dataclasses.replace(WELL, in_air=in_air), 1.0, now)
        assert safety.state is State.FLYING and safety.missing() == ()


def test_a_lost_position_brakes_until_it_is_clearly_found():
    safety, now = flying()
    now = run(safety, dataclasses.replace(WELL, velocity_std=LIMITS.velocity_std + 0.01), PERIOD, now)
    assert safety.state is State.BRAKING and safety.reaction is Reaction.BRAKE
    now = run(safety, dataclasses.replace(WELL, velocity_std=0.8 * LIMITS.velocity_std, speed=0.0), 0.1, now)
    assert safety.state is State.BRAKING  # without a position to hold it is not at rest
    now = run(safety, dataclasses.replace(WELL, velocity_std=0.6 * LIMITS.velocity_std), PERIOD, now)
    assert safety.state is State.FLYING
    now = run(safety, dataclasses.replace(WELL, velocity_std=0.8 * LIMITS.velocity_std), 1.0, now)
    assert safety.state is State.FLYING
    run(safety, dataclasses.replace(WELL, position_std=math.inf, speed=0.0), LIMITS.brake_time + 0.1, now)
    assert safety.state is State.HANDED_BACK


def test_an_unknown_uncertainty_is_no_fault():
    safety, now = flying()
    run(safety, dataclasses.replace(WELL, position_std=math.nan, velocity_std=math.nan), 1.0, now)
    assert safety.state is State.FLYING


def test_a_drone_that_is_armed_when_the_node_starts_is_left_alone():
    safety = SafetyMachine(LIMITS)
    now = run(safety, dataclasses.replace(WELL, offboard=False), 1.0, 0.0)
    now = run(safety, WELL, 1.0, now)
    assert safety.state is State.HANDED_BACK and safety.reaction is Reaction.SILENT
    now = run(safety, dataclasses.replace(WELL, armed=False, offboard=False), 0.1, now)
    run(safety, WELL, 0.1, now)
    assert safety.state is State.FLYING

    joining = SafetyMachine(dataclasses.replace(LIMITS, join_armed=True))
    now = run(joining, dataclasses.replace(WELL, offboard=False), 0.1, 0.0)
    run(joining, WELL, 0.1, now)
    assert joining.state is State.FLYING


def test_before_the_first_heartbeat_the_vehicle_does_not_count_as_disarmed():
    safety = SafetyMachine(LIMITS)
    unknown = dataclasses.replace(WELL, armed=False, offboard=False, heartbeat_age=math.inf)
    now = run(safety, unknown, 1.0, 0.0)
    run(safety, WELL, 0.1, now)
    assert safety.state is State.HANDED_BACK


def test_without_a_safe_plan_it_waits_and_then_hands_back_until_disarmed():
    safety, now = flying()
    stuck = dataclasses.replace(WELL, plan_status=PlanStatus.NO_SAFE_CANDIDATE)
    now = run(safety, stuck, 1.0, now)
    assert safety.state is State.BRAKING and safety.reaction is Reaction.BRAKE_AS_PLANNED
    stuck = dataclasses.replace(stuck, speed=0.1)
    now = run(safety, stuck, 1.0, now)
    assert safety.state is State.HOLDING
    now = run(safety, WELL, 0.02, now)
    assert safety.state is State.FLYING  # a safe plan is found
    now = run(safety, stuck, LIMITS.brake_time + LIMITS.hold_time - 2.1, now)  # 2 s were before
    assert safety.state is State.HOLDING
    now = run(safety, stuck, 0.3, now)
    assert safety.state is State.HANDED_BACK
    now = run(safety, dataclasses.replace(WELL, offboard=False), 5.0, now)
    now = run(safety, WELL, 5.0, now)
    assert safety.state is State.HANDED_BACK  # PX4 may return to OFFBOARD by itself, which must not start a flight


def test_stopping_the_node_brakes_first():
    safety, now = flying()
    now = run(safety, dataclasses.replace(WELL, stopping=True), 1.0, now)
    assert safety.state is State.BRAKING
    run(safety, dataclasses.replace(WELL, stopping=True, speed=0.1), 0.1, now)
    assert safety.state is State.HANDED_BACK
    safety, now = flying()
    run(safety, dataclasses.replace(WELL, stopping=True), LIMITS.brake_time + 0.1, now)
    assert safety.state is State.HANDED_BACK  # although it never came to rest


def test_without_a_date_signed_messages_make_nothing_ready():
    safety = SafetyMachine(LIMITS)
    undated = dataclasses.replace(WELL, clock_set=False, armed=False, offboard=False)
    run(safety, undated, 1.0, 0.0)
    assert safety.state is State.WAITING and safety.missing() == (Cause.CLOCK_UNSET,)
    run(safety, dataclasses.replace(undated, clock_set=True), 1.0, 1.0)
    assert safety.state is State.READY
