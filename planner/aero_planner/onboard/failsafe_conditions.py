"""When the causes of the failsafe table apply, and which of its rows does: functions of one tick's inputs."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from aero_planner.onboard.failsafe_table import (
    FAULTS,
    LOST,
    NOT_READY,
    TRANSITIONS,
    UNLOCATED,
    Cause,
    Inputs,
    State,
)
from aero_planner.onboard.settings import LimitSettings
from aero_planner.plan import PlanStatus

_RELEASE = 0.7
"""Fraction of a limit below which a poor or drifting estimate, or a late link, counts as good again."""


def _exceeds(age: float, limit: float) -> bool:
    """Return True if `age` exceeds `limit` or is NaN."""
    return not age <= limit


def _estimate_is_poor(inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if a standard deviation exceeds its limit; one that is unknown (NaN) does not.

    An estimate that was poor must become better than the limit before it counts as good.
    """
    scale = _RELEASE if inputs.estimate_was_poor else 1.0
    return inputs.position_std > scale * limits.position_std or inputs.velocity_std > scale * limits.velocity_std


def _cloud_drifts(inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if the drift exceeds a limit; one that is unknown (NaN) does not. Releases as above.

    In flight, an estimate that drifted must be seen to stand still again: a place without structure proves nothing.
    """
    if inputs.cloud_drifted and inputs.armed and inputs.offboard and math.isnan(inputs.drift_speed):
        return True
    scale = _RELEASE if inputs.cloud_drifted else 1.0
    angle = math.radians(limits.drift_angle)
    return inputs.drift_angle > scale * angle or inputs.drift_speed > scale * limits.drift_speed


def _link_is_late(inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if the round trip exceeds its limit; one that is unknown (NaN) does not. Releases as above.

    A link that was late must be measured again.
    """
    if inputs.link_was_late:
        return not inputs.round_trip <= _RELEASE * limits.round_trip
    return inputs.round_trip > limits.round_trip


_CONDITIONS: dict[Cause, Callable[[Inputs, LimitSettings], bool]] = {
    Cause.UNSUPPORTED: lambda i, _: not i.supported,
    Cause.TAKEN_OVER: lambda i, _: not (i.armed and i.offboard),
    Cause.ARMED_AT_START: lambda i, _: i.armed and not i.seen_disarmed,
    Cause.DISARMED: lambda i, _: not i.armed,
    Cause.ENGAGED: lambda i, _: i.armed and i.offboard,
    # Only a heartbeat that is newer than the state tells.
    Cause.NOT_ENGAGED: lambda i, _: not (i.armed and i.offboard) and i.heartbeat_age < i.state_time,
    Cause.LINK_LOST: lambda i, lim: _exceeds(i.heartbeat_age, lim.heartbeat_age),
    Cause.STATE_STALE: lambda i, lim: _exceeds(i.state_age, lim.state_age),
    Cause.STATE_NOT_FINITE: lambda i, _: not i.state_finite,
    Cause.FIX_LOST: lambda i, lim: i.fix_age > lim.fix_age,  # no fault without a fix before, where the age is NaN
    Cause.ESTIMATE_POOR: _estimate_is_poor,
    Cause.CLOUD_DRIFTS: _cloud_drifts,
    Cause.LINK_LATE: _link_is_late,
    Cause.TRANSMITTER_LOST: lambda i, _: i.transmitter_lost,
    Cause.BATTERY_LOW: lambda i, _: i.battery_low,
    Cause.BELOW_FLOOR: lambda i, _: i.below_floor,
    Cause.OUTSIDE_FENCE: lambda i, _: not i.inside_fence and not i.below_floor,
    Cause.LOOP_STALLED: lambda i, lim: _exceeds(i.loop_age, lim.deadline),
    Cause.CLOUD_STALE: lambda i, lim: _exceeds(i.cloud_age, lim.cloud_age),
    Cause.PLAN_NOT_FINITE: lambda i, _: not i.plan_finite,
    Cause.PLAN_STALE: lambda i, lim: _exceeds(i.plan_age, lim.plan_age),
    Cause.PLAN_UNSAFE: lambda i, _: i.plan_status != PlanStatus.OK,
    Cause.ON_GROUND: lambda i, _: i.in_air is False,
    Cause.IN_AIR_UNKNOWN: lambda i, _: i.in_air is None,
    Cause.UNGUARDED: lambda i, _: not i.guarded,
    Cause.CLOCK_UNSET: lambda i, _: not i.clock_set,
    Cause.STOPPING: lambda i, _: i.stopping,
    Cause.STATE_TIMEOUT: lambda i, lim: _exceeds(i.state_age, lim.state_age + lim.blind_time),
    Cause.LINK_TIMEOUT: lambda i, lim: _exceeds(i.heartbeat_age, lim.heartbeat_age + lim.blind_time),
    Cause.LOOP_TIMEOUT: lambda i, lim: _exceeds(i.loop_age, lim.deadline + lim.blind_time),
    Cause.BRAKE_TIMEOUT: lambda i, lim: i.state_time > lim.brake_time,
    Cause.HOLD_TIMEOUT: lambda i, lim: i.fault_time > lim.brake_time + lim.hold_time,
    Cause.AT_REST: lambda i, lim: not _has_any(UNLOCATED, i, lim) and i.speed <= lim.speed_stopped,
    Cause.GOAL_REACHED: lambda i, lim: i.goal_distance <= lim.arrival_radius,
    # The drone drifts a little while it holds, so a goal that was reached is left at a larger distance.
    Cause.GOAL_MOVED: lambda i, lim: (
        _may_fly(i, lim) and i.goal_distance > (1.0 if i.goal_new else 2.0) * lim.arrival_radius
    ),
    # A drone that alternates between flying and braking for too long is brought to rest, and then handed back.
    Cause.ALL_CLEAR: lambda i, lim: _may_fly(i, lim) and not cause_applies(Cause.HOLD_TIMEOUT, i, lim),
    Cause.STANDBY: lambda i, lim: _may_fly(i, lim) and not (i.armed and i.offboard),
}


def cause_applies(cause: Cause, inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if the condition of `cause` is met."""
    return _CONDITIONS[cause](inputs, limits)


def find_faults(inputs: Inputs, limits: LimitSettings) -> tuple[Cause, ...]:
    """Return the faults that are present, the most severe first."""
    return tuple(fault for fault in FAULTS if cause_applies(fault, inputs, limits))


def _may_fly(inputs: Inputs, limits: LimitSettings) -> bool:
    return not inputs.stopping and not _has_any((*FAULTS, *NOT_READY), inputs, limits)


def _has_any(causes: tuple[Cause, ...], inputs: Inputs, limits: LimitSettings) -> bool:
    return any(cause_applies(cause, inputs, limits) for cause in causes)


def is_lost(inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if a fault is present with which position and velocity drift."""
    return _has_any(LOST, inputs, limits)


def must_wait_after_stall(inputs: Inputs, limits: LimitSettings) -> bool:
    """Return True if a loop that has stalled leaves the drone to those who brake in its place.

    What arrived during the stall is not yet read, or the stall was too long to continue.
    """
    return any(cause_applies(cause, inputs, limits) for cause in (Cause.STATE_STALE, Cause.LOOP_TIMEOUT))


def blind_time_left(inputs: Inputs, limits: LimitSettings) -> float:
    """Return the time until STATE_TIMEOUT or LINK_TIMEOUT applies [s].

    It is infinite while vehicle states and heartbeats arrive in time.
    """
    overdue = max(inputs.state_age - limits.state_age, inputs.heartbeat_age - limits.heartbeat_age)
    return limits.blind_time - overdue if overdue > 0.0 else math.inf


def next_state(state: State, inputs: Inputs, limits: LimitSettings) -> tuple[State, Cause | None]:
    """Return the next state and its cause, or `state` and None if no row applies."""
    for row in TRANSITIONS:
        if state in row.sources and cause_applies(row.cause, inputs, limits):
            return row.target, row.cause
    return state, None


def is_inside_fence(position: ArrayLike, limits: LimitSettings, *, ground: float = 0.0) -> bool:
    """Return True if `position` [m], shape [3], world frame, lies inside the geofence; NaN never does.

    `ground` is the height of the ground, world frame [m], from which the fence's heights count.
    """
    x, y, z = np.asarray(position, dtype=np.float64).tolist()
    return (
        math.hypot(x, y) <= limits.fence_radius
        and limits.fence_height_min <= z - ground <= limits.fence_height_max
        and limits.fence_x_min <= x <= limits.fence_x_max
        and limits.fence_y_min <= y <= limits.fence_y_max
    )
