"""Inputs of the safety machine, and the invariants that every one of its steps keeps."""

import dataclasses
import math

from aero_planner import PlanStatus
from aero_planner.onboard.failsafe_conditions import cause_applies, find_faults, next_state
from aero_planner.onboard.failsafe_table import (
    COMMANDING,
    MAYBE_COMMANDING,
    UNLOCATED,
    Inputs,
    Reaction,
    State,
    reaction_to,
)
from aero_planner.onboard.settings import LimitSettings

LIMITS = LimitSettings()
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
    scale = 0.7 if inputs.cloud_drifted else 1.0
    drifts = inputs.drift_speed > scale * LIMITS.drift_speed
    drifts = drifts or inputs.drift_angle > scale * math.radians(LIMITS.drift_angle)
    # One that drifted in flight must be measured again.
    drifts = drifts or (inputs.cloud_drifted and inputs.armed and inputs.offboard and math.isnan(inputs.drift_speed))
    is_fixed = math.isnan(inputs.fix_age) or inputs.fix_age <= LIMITS.fix_age
    reserves = not inputs.transmitter_lost and not inputs.battery_low
    is_late = inputs.round_trip > LIMITS.round_trip
    is_late = is_late or (inputs.link_was_late and not inputs.round_trip <= 0.7 * LIMITS.round_trip)
    return reserves and not is_late and fresh and right and is_fixed and not poor and not drifts and not inputs.stopping


def may_begin_to_fly(inputs: Inputs) -> bool:
    """Return True if every condition of READY is met, by a definition independent of the machine's."""
    return is_well(inputs) and inputs.in_air is True and inputs.guarded and inputs.supported and inputs.clock_set


def check_one_step(state: State, inputs: Inputs, target: State) -> None:
    """Check the invariants of every single step, whatever came before."""
    reaction = reaction_to(target, find_faults(inputs, LIMITS))
    ours, well = inputs.armed and inputs.offboard, is_well(inputs)
    if not inputs.supported:
        assert reaction is Reaction.SILENT
    if not ours:
        # Outside OFFBOARD nothing is sent except the stream that PX4 requires, without faults, and what follows it
        # until a heartbeat tells that the pilot has not switched.
        if target is State.WITHDRAWING:
            assert reaction is Reaction.BRAKE and state in MAYBE_COMMANDING
            assert state is State.READY or not inputs.heartbeat_age < inputs.state_time
        else:
            assert reaction is Reaction.SILENT or (target is State.READY and reaction is Reaction.BRAKE and well)
    if reaction is Reaction.STREAM_PLAN:
        assert ours and well
    unsafe = inputs.plan_status is not PlanStatus.OK
    right = dataclasses.replace(inputs, plan_status=PlanStatus.OK, cloud_age=0.0, stopping=False)
    only_unsafe = unsafe and is_well(right)  # a plan may be unsafe because of a stale cloud
    assert (reaction is Reaction.BRAKE_AS_PLANNED) == (target is State.BRAKING and only_unsafe)
    if target is State.READY or (target is State.FLYING and target is not state):
        assert may_begin_to_fly(inputs)
    if target is State.FLYING and state is not State.FLYING:
        # What the machine itself requires of a drone that the pilot still flies is required again.
        before = dataclasses.replace(inputs, armed=False, offboard=False)
        assert next_state(State.WAITING, before, LIMITS)[0] is State.READY
    if target is State.FLYING and state in (State.BRAKING, State.HOLDING):
        assert inputs.fault_time <= LIMITS.brake_time + LIMITS.hold_time
    if target is State.READY:
        # A node that finds itself in OFFBOARD does not start.
        assert not ours
    if reaction is Reaction.HOLD and target is State.HOLDING:
        assert not any(cause_applies(fault, inputs, LIMITS) for fault in UNLOCATED)
    if state is State.HANDED_BACK:
        assert target is State.HANDED_BACK or not inputs.armed
    if target in COMMANDING and state not in COMMANDING:
        assert state in MAYBE_COMMANDING and ours and inputs.seen_disarmed and inputs.in_air is True
        assert (well and target is State.FLYING) if state is State.READY else target is State.BRAKING
    if target in MAYBE_COMMANDING:
        assert state in (State.WAITING, *MAYBE_COMMANDING) and inputs.in_air is True
