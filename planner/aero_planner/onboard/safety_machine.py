"""When the node may command the drone, and what it does when something is wrong: a state machine as a table.

Pure: no clocks, no threads, no I/O. Times come in as data. Diagram and failsafe table of the documentation, and the
tests that explore the machine, derive from `TRANSITIONS`. Nothing here can arm or change the mode: no state has a
reaction that would.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import ArrayLike

from aero_planner.onboard.settings import LimitSettings
from aero_planner.plan import PlanStatus

__all__ = [
    "AS_PLANNED",
    "BLINDING",
    "COMMANDING",
    "DETECTION",
    "FAULTS",
    "HARMLESS_AT_REST",
    "REACTIONS",
    "REACTIONS_TO",
    "TRANSITIONS",
    "Cause",
    "Change",
    "Inputs",
    "Reaction",
    "SafetyMachine",
    "State",
    "Transition",
    "blind_time_left",
    "faults",
    "holds",
    "inside_fence",
    "next_state",
    "reaction_to",
]


class State(enum.Enum):
    """What the node is doing."""

    WAITING = "something that flying needs is missing, or the pilot flies"
    READY = "everything is there; the pilot may switch to OFFBOARD"
    FLYING = "the plan is flown"
    ARRIVED = "the goal is reached; the drone waits there"
    BRAKING = "something is wrong; the drone is brought to rest"
    HOLDING = "the drone is at rest and waits for a way to go on"
    HANDED_BACK = "the autopilot has the drone until it is disarmed"


class Reaction(enum.Enum):
    """What is sent to the autopilot."""

    SILENT = "nothing: the autopilot leaves OFFBOARD by its own failsafe, unless it has already"
    STREAM_PLAN = "the planned controls"
    BRAKE = "what brings the drone to rest, level; by dead reckoning where the state is stale"
    BRAKE_AS_PLANNED = "the planned controls, which bring the drone to rest, away from obstacles"
    HOLD = "what brings the drone to rest and keeps it there"


REACTIONS: dict[State, Reaction] = {
    State.WAITING: Reaction.SILENT,
    # PX4 accepts OFFBOARD only while setpoints arrive. Until it has, it ignores what they say; from then until its next
    # heartbeat tells so, up to a second later, it obeys them: they must be harmless.
    State.READY: Reaction.BRAKE,
    State.FLYING: Reaction.STREAM_PLAN,
    State.ARRIVED: Reaction.HOLD,
    State.BRAKING: Reaction.BRAKE,
    State.HOLDING: Reaction.HOLD,
    State.HANDED_BACK: Reaction.SILENT,
}

AS_PLANNED = (Reaction.STREAM_PLAN, Reaction.BRAKE_AS_PLANNED)
"""Reactions that send what the plan says."""


@dataclass(frozen=True)
class Inputs:
    """What is known at one tick of the control loop. Ages are infinite for what has not come yet [s]."""

    armed: bool
    offboard: bool
    state_age: float
    """Of the newest finite state of the vehicle."""
    heartbeat_age: float
    cloud_age: float
    """Of the newest point."""
    plan_age: float
    """Of the state from which the newest finite plan was made."""
    plan_status: PlanStatus
    state_finite: bool
    """Whether the newest state holds no NaN and no infinity."""
    plan_finite: bool
    """Whether the newest plan does."""
    inside_fence: bool
    loop_age: float
    """Since the tick before began; 0 at the first."""
    speed: float
    """[m/s]"""
    goal_distance: float
    """[m]"""
    goal_number: int = 0
    """Counts the goals given."""
    stopping: bool = False
    """Whether the node has been told to end."""
    seen_disarmed: bool = True
    """Whether the vehicle was disarmed at any time since the start; `SafetyMachine` fills this and the next three."""
    state_time: float = 0.0
    """Since the present state was entered [s]."""
    fault_time: float = 0.0
    """Since the plan was last flown, or the goal last held [s]."""
    goal_new: bool = False
    """Whether the goal is another one than the last that was reached."""


class Cause(enum.Enum):
    """Why a state is left."""

    TAKEN_OVER = "the vehicle is disarmed or has left OFFBOARD"
    ARMED_AT_START = "the vehicle was armed already when the node started"
    DISARMED = "the vehicle is disarmed"
    ENGAGED = "the pilot has switched to OFFBOARD"
    LINK_LOST = "no heartbeat from the autopilot"
    STATE_STALE = "no state from the autopilot"
    STATE_NOT_FINITE = "a number in the vehicle's state is not finite"
    FENCE = "outside the geofence"
    OVERRUN = "the control loop stood still"
    CLOUD_STALE = "no points from the LiDAR: none arrive, or nothing is in range"
    PLAN_NOT_FINITE = "a number in the plan is not finite"
    PLAN_STALE = "no plan in time: the planner is late, hangs or fails"
    UNSAFE = "no safe candidate, or a plan on a stale cloud"
    STOPPING = "the node is told to end"
    STATE_GONE = "no state for too long to go on by dead reckoning"
    LINK_GONE = "no heartbeat for too long to go on"
    LOOP_GONE = "the control loop stood still for too long to go on"
    CANNOT_STOP = "not at rest in time"
    NO_WAY = "no way to go on was found in time"
    STOPPED = "at rest"
    REACHED = "the goal is reached"
    GOAL_MOVED = "the goal is elsewhere and all is well"
    WELL = "all is well"
    STANDBY = "all is well and the vehicle is not under our control"


FAULTS = (
    Cause.LINK_LOST, Cause.STATE_STALE, Cause.STATE_NOT_FINITE, Cause.FENCE, Cause.OVERRUN, Cause.CLOUD_STALE,
    Cause.PLAN_NOT_FINITE, Cause.PLAN_STALE, Cause.UNSAFE,
)  # fmt: skip
"""What stands against flying a plan, the gravest first."""

REACTIONS_TO: dict[tuple[State, tuple[Cause, ...]], Reaction] = {
    # Of a plan that is not safe the controls are the planner's own way to brake, chosen by what is in the way.
    (State.BRAKING, (Cause.UNSAFE,)): Reaction.BRAKE_AS_PLANNED,
    # So it is with a stale cloud, which the plan has noticed: trees stand where they stood.
    (State.BRAKING, (Cause.CLOUD_STALE, Cause.UNSAFE)): Reaction.BRAKE_AS_PLANNED,
}
"""In the place of `REACTIONS` where these faults, and no others, stand against flying."""

BLINDING = (Cause.LINK_LOST, Cause.STATE_STALE, Cause.STATE_NOT_FINITE)
"""Faults that leave nothing but dead reckoning."""

HARMLESS_AT_REST = (Cause.CLOUD_STALE, Cause.PLAN_NOT_FINITE, Cause.PLAN_STALE, Cause.UNSAFE)
"""Faults that do not matter to a drone that waits at its goal."""

DETECTION: dict[Cause, tuple[str, ...]] = {
    Cause.LINK_LOST: ("limits.heartbeat_age",),
    Cause.STATE_STALE: ("limits.state_age",),
    Cause.STATE_NOT_FINITE: ("limits.state_age",),  # at the latest: a link that drops such states lets them be stale
    Cause.FENCE: (),
    Cause.OVERRUN: ("limits.deadline",),
    Cause.CLOUD_STALE: ("limits.cloud_age",),
    Cause.PLAN_NOT_FINITE: (),
    Cause.PLAN_STALE: ("limits.plan_age",),
    Cause.UNSAFE: (),
    Cause.STOPPING: (),
    Cause.TAKEN_OVER: (),
    Cause.STATE_GONE: ("limits.state_age", "limits.blind_time"),
    Cause.LINK_GONE: ("limits.heartbeat_age", "limits.blind_time"),
    Cause.LOOP_GONE: ("limits.deadline", "limits.blind_time"),
    Cause.CANNOT_STOP: ("limits.brake_time",),
    Cause.NO_WAY: ("limits.brake_time", "limits.hold_time"),
}
"""Settings whose sum is the time from the event to its detection; the reaction follows within one control period."""

FailsafeProcess = Callable[[Inputs, LimitSettings], bool]


def _older(age: float, limit: float) -> bool:
    """Whether `age` exceeds `limit`; NaN does."""
    return not age <= limit


_GUARDS: dict[Cause, FailsafeProcess] = {
    Cause.TAKEN_OVER: lambda i, _: not (i.armed and i.offboard),
    Cause.ARMED_AT_START: lambda i, _: i.armed and not i.seen_disarmed,
    Cause.DISARMED: lambda i, _: not i.armed,
    Cause.ENGAGED: lambda i, _: i.armed and i.offboard,
    Cause.LINK_LOST: lambda i, m: _older(i.heartbeat_age, m.heartbeat_age),
    Cause.STATE_STALE: lambda i, m: _older(i.state_age, m.state_age),
    Cause.STATE_NOT_FINITE: lambda i, _: not i.state_finite,
    Cause.FENCE: lambda i, _: not i.inside_fence,
    Cause.OVERRUN: lambda i, m: _older(i.loop_age, m.deadline),
    Cause.CLOUD_STALE: lambda i, m: _older(i.cloud_age, m.cloud_age),
    Cause.PLAN_NOT_FINITE: lambda i, _: not i.plan_finite,
    Cause.PLAN_STALE: lambda i, m: _older(i.plan_age, m.plan_age),
    Cause.UNSAFE: lambda i, _: i.plan_status != PlanStatus.OK,
    Cause.STOPPING: lambda i, _: i.stopping,
    Cause.STATE_GONE: lambda i, m: _older(i.state_age, m.state_age + m.blind_time),
    Cause.LINK_GONE: lambda i, m: _older(i.heartbeat_age, m.heartbeat_age + m.blind_time),
    Cause.LOOP_GONE: lambda i, m: _older(i.loop_age, m.deadline + m.blind_time),
    Cause.CANNOT_STOP: lambda i, m: i.state_time > m.brake_time,
    Cause.NO_WAY: lambda i, m: i.fault_time > m.brake_time + m.hold_time,
    Cause.STOPPED: lambda i, m: _sighted(i, m) and i.speed <= m.speed_stopped,
    Cause.REACHED: lambda i, m: i.goal_distance <= m.arrival_radius,
    # Held against drift, an old goal is left less easily than it is reached.
    Cause.GOAL_MOVED: lambda i, m: _well(i, m) and i.goal_distance > (1.0 if i.goal_new else 2.0) * m.arrival_radius,
    Cause.WELL: lambda i, m: _well(i, m),
    Cause.STANDBY: lambda i, m: _well(i, m) and not (i.armed and i.offboard),
}


def holds(cause: Cause, inputs: Inputs, limits: LimitSettings) -> bool:
    """Return whether `cause` applies."""
    return _GUARDS[cause](inputs, limits)


def faults(inputs: Inputs, limits: LimitSettings) -> tuple[Cause, ...]:
    """Return what stands against flying a plan, the gravest first."""
    return tuple(fault for fault in FAULTS if holds(fault, inputs, limits))


def reaction_to(state: State, faults: tuple[Cause, ...]) -> Reaction:
    """Return what is to be sent in `state` while `faults`, in the order of `FAULTS`, stand against flying."""
    return REACTIONS_TO.get((state, faults), REACTIONS[state])


def _well(inputs: Inputs, limits: LimitSettings) -> bool:
    return not inputs.stopping and not faults(inputs, limits)


def _sighted(inputs: Inputs, limits: LimitSettings) -> bool:
    return not any(holds(fault, inputs, limits) for fault in BLINDING)


def blind_time_left(inputs: Inputs, limits: LimitSettings) -> float:
    """Return the time until STATE_GONE or LINK_GONE applies [s]; infinite while states and heartbeats come in time."""
    over = max(inputs.state_age - limits.state_age, inputs.heartbeat_age - limits.heartbeat_age)
    return limits.blind_time - over if over > 0.0 else math.inf


@dataclass(frozen=True)
class Transition:
    """One row of the table: from each of `sources`, when `cause` applies, to `target`."""

    sources: tuple[State, ...]
    cause: Cause
    target: State


_S = State

COMMANDING = (_S.FLYING, _S.ARRIVED, _S.BRAKING, _S.HOLDING)
"""States in which the drone obeys."""

TRANSITIONS: tuple[Transition, ...] = (
    # Watchdog or guard have braked to the end and handed back: a mode that says otherwise may be the failsafe's.
    Transition(COMMANDING, Cause.LOOP_GONE, _S.HANDED_BACK),
    # The pilot always wins.
    Transition(COMMANDING, Cause.TAKEN_OVER, _S.WAITING),
    Transition((_S.HANDED_BACK,), Cause.DISARMED, _S.WAITING),
    Transition((_S.WAITING, _S.READY), Cause.ARMED_AT_START, _S.HANDED_BACK),
    # What is too bad or lasts too long goes back to the autopilot.
    Transition(COMMANDING, Cause.STATE_GONE, _S.HANDED_BACK),
    Transition(COMMANDING, Cause.LINK_GONE, _S.HANDED_BACK),
    Transition((_S.BRAKING,), Cause.CANNOT_STOP, _S.HANDED_BACK),
    Transition((_S.BRAKING, _S.HOLDING), Cause.NO_WAY, _S.HANDED_BACK),
    Transition((_S.ARRIVED, _S.HOLDING), Cause.STOPPING, _S.HANDED_BACK),
    # What is wrong now.
    Transition((_S.READY,), Cause.STOPPING, _S.WAITING),
    *(Transition((_S.READY,), fault, _S.WAITING) for fault in FAULTS),
    Transition((_S.FLYING,), Cause.STOPPING, _S.BRAKING),
    *(Transition((_S.FLYING,), fault, _S.BRAKING) for fault in FAULTS),
    *(Transition((_S.ARRIVED,), fault, _S.BRAKING) for fault in FAULTS if fault not in HARMLESS_AT_REST),
    *(Transition((_S.HOLDING,), fault, _S.BRAKING) for fault in BLINDING),
    # What is well again, or done.
    Transition((_S.BRAKING, _S.HOLDING), Cause.WELL, _S.FLYING),
    Transition((_S.BRAKING,), Cause.STOPPED, _S.HOLDING),
    Transition((_S.FLYING,), Cause.REACHED, _S.ARRIVED),
    Transition((_S.ARRIVED,), Cause.GOAL_MOVED, _S.FLYING),
    Transition((_S.READY,), Cause.ENGAGED, _S.FLYING),
    Transition((_S.WAITING,), Cause.STANDBY, _S.READY),
)
"""Tried from top to bottom; the first row that applies is taken, at most one per tick."""


def next_state(state: State, inputs: Inputs, limits: LimitSettings) -> tuple[State, Cause | None]:
    """Return the state after `state`, and why; the same and None when no row applies."""
    for row in TRANSITIONS:
        if state in row.sources and holds(row.cause, inputs, limits):
            return row.target, row.cause
    return state, None


def inside_fence(position: ArrayLike, limits: LimitSettings) -> bool:
    """Return whether `position` [m], shape [3], world frame, lies inside the geofence; NaN does not."""
    x, y, z = (float(value) for value in position)  # type: ignore[union-attr]
    return (
        math.hypot(x, y) <= limits.fence_radius
        and limits.fence_height_min <= z <= limits.fence_height_max
        and limits.fence_x_min <= x <= limits.fence_x_max
        and limits.fence_y_min <= y <= limits.fence_y_max
    )


@dataclass(frozen=True)
class Change:
    """A transition that happened."""

    time: float
    """Of the clock that `SafetyMachine.step` was given [s]."""
    source: State
    target: State
    cause: Cause

    def __str__(self) -> str:
        return f"{self.source.name} -> {self.target.name}: {self.cause.value}"


class SafetyMachine:
    """The state machine in time.

    Args:
        limits: see `LimitSettings`.
        on_change: called with every transition.
    """

    def __init__(self, limits: LimitSettings, *, on_change: Callable[[Change], None] | None = None) -> None:
        self.state = State.WAITING
        self.inputs: Inputs | None = None
        """Of the newest step."""
        self._limits = limits
        self._on_change = on_change
        self._seen_disarmed = limits.join_armed
        self._entered = self._flown = -math.inf
        self._reached = 0

    @property
    def reaction(self) -> Reaction:
        """What is to be sent now."""
        return reaction_to(self.state, self.missing())

    def missing(self) -> tuple[Cause, ...]:
        """Return what stands against flying, as of the newest step."""
        return () if self.inputs is None else faults(self.inputs, self._limits)

    def step(self, now: float, inputs: Inputs) -> Reaction:
        """Take one tick's inputs in at the time `now` [s] and return what is to be sent."""
        # Before the first heartbeat nothing is known of the motors.
        self._seen_disarmed |= not inputs.armed and math.isfinite(inputs.heartbeat_age)
        if self.state in (State.FLYING, State.ARRIVED):
            self._flown = now
        self.inputs = dataclasses.replace(
            inputs,
            seen_disarmed=self._seen_disarmed,
            state_time=now - self._entered,
            fault_time=now - self._flown,
            goal_new=inputs.goal_number != self._reached,
        )
        target, cause = next_state(self.state, self.inputs, self._limits)
        if cause is not None:
            change = Change(now, self.state, target, cause)
            self.state, self._entered = target, now
            if cause is Cause.REACHED:
                self._reached = inputs.goal_number
            if self._on_change is not None:
                self._on_change(change)
        return self.reaction
