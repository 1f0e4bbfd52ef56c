import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlanStatus
from aero_planner.onboard.failsafe_table import (
    AS_PLANNED,
    COMMANDING,
    DETECTION,
    FAULTS,
    HARMLESS_AT_REST,
    REACTIONS,
    TRANSITIONS,
    UNLOCATED,
    Cause,
    Inputs,
    Reaction,
    State,
    cause_applies,
    find_faults,
    is_inside_fence,
    next_state,
    reaction_to,
)
from aero_planner.onboard.safety_docs import format_diagram, format_failsafes, format_states
from aero_planner.onboard.safety_machine import SafetyMachine
from aero_planner.onboard.settings import LimitSettings, OnboardConfig

LIMITS = LimitSettings()
PERIOD = 0.02
DOCS = Path(__file__).parents[3] / "docs" / "onboard.md"

WELL = Inputs(
    armed=True,
    offboard=True,
    state_age=0.01,
    heartbeat_age=0.5,
    cloud_age=0.05,
    plan_age=0.05,
    plan_status=PlanStatus.OK,
    state_finite=True,
    plan_finite=True,
    in_air=True,
    position_std=0.2,
    velocity_std=0.05,
    fix_age=0.1,
    drift_angle=math.nan,
    drift_speed=0.1,
    inside_fence=True,
    loop_age=0.02,
    speed=3.0,
    goal_distance=20.0,
)

# Faults, and the inputs that they change. Ages are just beyond their limit, NaN, or far beyond the limit.
BREAKS: dict[str, dict[str, object]] = {
    "link": {"heartbeat_age": LIMITS.heartbeat_age + 0.1},
    "link gone": {"heartbeat_age": math.inf},
    "state": {"state_age": LIMITS.state_age + 0.01},
    "state gone": {"state_age": LIMITS.state_age + LIMITS.blind_time + 0.01},
    "state age unknown": {"state_age": math.nan},
    "state not finite": {"state_finite": False, "speed": math.nan, "goal_distance": math.nan},
    "fix lost": {"fix_age": LIMITS.fix_age + 0.01},
    "position uncertain": {"position_std": LIMITS.position_std + 0.01},
    "velocity uncertain": {"velocity_std": math.inf},
    "uncertainty still too large": {"velocity_std": 0.9 * LIMITS.velocity_std, "estimate_was_poor": True},
    "fence": {"inside_fence": False},
    "overrun": {"loop_age": LIMITS.deadline + 0.01},
    "loop gone": {"loop_age": LIMITS.deadline + LIMITS.blind_time + 0.01},
    "cloud": {"cloud_age": math.inf},
    "cloud age unknown": {"cloud_age": math.nan},
    "plan": {"plan_age": LIMITS.plan_age + 0.01},
    "no plan": {"plan_age": math.inf},
    "plan not finite": {"plan_finite": False},
    "unsafe": {"plan_status": PlanStatus.NO_SAFE_CANDIDATE},
    "stale for the planner": {"plan_status": PlanStatus.STALE_CLOUD},
    "on the ground": {"in_air": False},
    "landed state unknown": {"in_air": None},
    "cloud turns": {"drift_angle": math.radians(LIMITS.drift_angle) + 0.01},
    "cloud moves": {"drift_speed": LIMITS.drift_speed + 0.01},
}


def every_input() -> Iterator[Inputs]:
    """Yield all inputs with at most two faults, in every mode, at rest or moving, before and after time limits."""
    broken = [(), *itertools.combinations(BREAKS, 1), *itertools.combinations(BREAKS, 2)]
    for names in broken:
        base = WELL
        for name in names:
            base = dataclasses.replace(base, **BREAKS[name])  # type: ignore[arg-type]
        for armed, offboard, stopping, seen, slow, near, long in itertools.product((True, False), repeat=7):
            yield dataclasses.replace(
                base,
                armed=armed,
                offboard=offboard,
                stopping=stopping,
                seen_disarmed=seen or not armed,
                speed=0.1 if slow and not math.isnan(base.speed) else base.speed,
                goal_distance=0.2 if near and not math.isnan(base.goal_distance) else base.goal_distance,
                state_time=100.0 if long else 0.1,
                fault_time=100.0 if long else 0.1,
            )


ALL_INPUTS = tuple(every_input())


def is_well(inputs: Inputs) -> bool:
    """Return True if there is no fault, by a definition independent of the machine's."""
    ages = (
        (inputs.heartbeat_age, LIMITS.heartbeat_age), (inputs.state_age, LIMITS.state_age),
        (inputs.cloud_age, LIMITS.cloud_age), (inputs.plan_age, LIMITS.plan_age), (inputs.loop_age, LIMITS.deadline),
    )  # fmt: skip
    fresh = all(age <= limit for age, limit in ages)  # false for NaN
    right = inputs.state_finite and inputs.plan_finite and inputs.inside_fence and inputs.plan_status is PlanStatus.OK
    scale = 0.7 if inputs.estimate_was_poor else 1.0
    poor = inputs.position_std > scale * LIMITS.position_std or inputs.velocity_std > scale * LIMITS.velocity_std
    is_fixed = math.isnan(inputs.fix_age) or inputs.fix_age <= LIMITS.fix_age
    return fresh and right and is_fixed and not poor and not inputs.stopping


def check_one_step(state: State, inputs: Inputs, target: State) -> None:
    """Check the invariants of every single step, whatever came before."""
    reaction = reaction_to(target, find_faults(inputs, LIMITS))
    ours, well = inputs.armed and inputs.offboard, is_well(inputs)
    if not ours:
        # Outside OFFBOARD nothing is sent except the stream that PX4 requires, and only without faults.
        assert reaction is Reaction.SILENT or (target is State.READY and reaction is Reaction.BRAKE and well)
    if reaction is Reaction.STREAM_PLAN:
        assert ours and well
    unsafe = inputs.plan_status is not PlanStatus.OK
    right = dataclasses.replace(inputs, plan_status=PlanStatus.OK, cloud_age=0.0, stopping=False)
    only_unsafe = unsafe and is_well(right)  # a plan may be unsafe because of a stale cloud
    assert (reaction is Reaction.BRAKE_AS_PLANNED) == (target is State.BRAKING and only_unsafe)
    if target is State.READY:
        assert well and not ours  # a node that finds itself in OFFBOARD does not start
        assert inputs.in_air is True  # nor one that finds itself on the ground
        assert not inputs.drift_speed > LIMITS.drift_speed and not inputs.drift_angle > math.radians(LIMITS.drift_angle)
    if reaction is Reaction.HOLD and target is State.HOLDING:
        assert not any(cause_applies(fault, inputs, LIMITS) for fault in UNLOCATED)
    if state is State.HANDED_BACK:
        assert target is State.HANDED_BACK or not inputs.armed
    if target in COMMANDING and state not in COMMANDING:
        assert state is State.READY and ours and well and inputs.seen_disarmed and inputs.in_air is True


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_invariants_hold_for_every_input(state: State):
    for inputs in ALL_INPUTS:
        check_one_step(state, inputs, next_state(state, inputs, LIMITS)[0])


def test_every_row_can_be_taken_and_every_cause_is_used():
    taken = set()
    for state, inputs in itertools.product(State, ALL_INPUTS):
        for row in TRANSITIONS:
            if state in row.sources and cause_applies(row.cause, inputs, LIMITS):
                taken.add(row)
                break
    assert taken == set(TRANSITIONS)
    assert {row.cause for row in TRANSITIONS} == set(Cause)
    assert set(DETECTION) >= set(FAULTS) and set(REACTIONS) == set(State)


def test_no_state_is_a_dead_end():
    """Without faults, a pilot who lands, disarms and tries again reaches FLYING from every state."""
    patient = dataclasses.replace(WELL, armed=False, offboard=False), dataclasses.replace(WELL, offboard=False), WELL
    for start in State:
        state = start
        for inputs in patient:
            for _ in range(3):
                state, _ = next_state(state, inputs, LIMITS)
        assert state is State.FLYING, start


def test_persistent_faults_end_in_silence_or_at_rest():
    """No persistent input causes an endless chain of transitions, or a flight with faults."""
    for state, inputs in itertools.product(State, ALL_INPUTS):
        chain = [state]
        while (target := next_state(chain[-1], inputs, LIMITS)[0]) is not chain[-1]:
            chain.append(target)
            assert len(chain) < 8, (chain, inputs)
        broken = find_faults(inputs, LIMITS)
        if broken:
            assert REACTIONS[chain[-1]] is not Reaction.STREAM_PLAN
        if broken and inputs.fault_time > LIMITS.brake_time + LIMITS.hold_time:
            resting = chain[-1] is State.ARRIVED and set(broken) <= set(HARMLESS_AT_REST)
            assert REACTIONS[chain[-1]] is Reaction.SILENT or resting


SOURCES: tuple[str, ...] = (
    "link", "state", "estimate", "cloud", "plan", "fence", "status", "nan state", "nan plan", "overrun",
)  # fmt: skip
"""Faults that last for a while."""
CAUSES = {
    "link": Cause.LINK_LOST, "state": Cause.STATE_STALE, "estimate": Cause.ESTIMATE_POOR,
    "cloud": Cause.CLOUD_STALE, "plan": Cause.PLAN_STALE,
    "fence": Cause.OUTSIDE_FENCE, "status": Cause.PLAN_UNSAFE, "nan state": Cause.STATE_NOT_FINITE,
    "nan plan": Cause.PLAN_NOT_FINITE, "overrun": Cause.LOOP_STALLED,
}  # fmt: skip

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
    since_flying = 0.0
    for duration, broken, mode, speed in plan:
        for _ in range(round(duration / PERIOD)):
            before = world.safety.state
            reaction = world.step(broken, mode, speed)
            assert world.safety.inputs is not None
            check_one_step(before, world.safety.inputs, world.safety.state)
            for name in broken:
                stated = sum(float(config.get(path)) for path in DETECTION[CAUSES[name]])
                if world.broken_for(name) > stated + PERIOD:
                    assert reaction not in AS_PLANNED or (
                        name in ("status", "cloud") and reaction is Reaction.BRAKE_AS_PLANNED
                    ), name
            blind = max(world.broken_for("state"), world.broken_for("nan state"))
            if blind > LIMITS.state_age + LIMITS.blind_time + 2 * PERIOD:
                assert reaction is Reaction.SILENT
            flying = world.safety.state in (State.FLYING, State.ARRIVED)
            since_flying = 0.0 if flying else since_flying + PERIOD
            if since_flying > LIMITS.brake_time + LIMITS.hold_time + 3 * PERIOD and mode == "offboard":
                assert reaction is Reaction.SILENT or world.safety.state is State.READY


def run(safety: SafetyMachine, inputs: Inputs, seconds: float, start: float) -> float:
    for _ in range(round(seconds / PERIOD)):
        start += PERIOD
        safety.step(start, inputs)
    return start


def flying() -> tuple[SafetyMachine, float]:
    safety = SafetyMachine(LIMITS)
    now = run(safety, dataclasses.replace(WELL, armed=False, offboard=False), 0.1, 0.0)
    now = run(safety, WELL, 0.1, now)
    assert safety.state is State.FLYING
    return safety, now


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


def test_a_cloud_that_drifts_prevents_a_take_over_and_disturbs_no_flight():
    drifting = dataclasses.replace(WELL, drift_speed=LIMITS.drift_speed + 0.01)
    safety = SafetyMachine(LIMITS)
    now = run(safety, dataclasses.replace(drifting, armed=False, offboard=False), 0.1, 0.0)
    assert safety.state is State.WAITING and safety.missing() == (Cause.CLOUD_DRIFTS,)
    safety, now = flying()
    run(safety, drifting, 1.0, now)
    assert safety.state is State.FLYING


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
    now = run(safety, stuck, LIMITS.brake_time + LIMITS.hold_time - 0.1, now)
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


def test_the_fence_is_a_cylinder_and_a_box():
    limits = dataclasses.replace(LIMITS, fence_radius=10.0, fence_x_max=5.0, fence_y_min=-2.0)
    assert is_inside_fence((0.0, 0.0, 1.0), limits) and is_inside_fence((-9.9, 0.0, 30.0), limits)
    outside = [(6.0, 0, 1), (0, -2.1, 1), (-10.1, 0, 1), (-8, 8, 1), (0, 0, 0.2), (0, 0, 30.1), (math.nan, 0, 1)]
    assert not any(is_inside_fence(np.array(place), limits) for place in outside)


def test_the_documentation_shows_the_table_that_is_flown():
    text = DOCS.read_text(encoding="utf-8")
    assert f"```mermaid\n{format_diagram()}\n```" in text
    assert f"\n{format_states()}\n" in text and f"\n{format_failsafes()}\n" in text
    for state in State:
        assert state.name in format_diagram()
