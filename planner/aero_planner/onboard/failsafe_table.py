"""The failsafes as a table: when the node may command the drone, and how it reacts to each fault.

This module is pure data; `failsafe_conditions` evaluates it for one tick, and `safety_machine` runs it over time. The
diagram and the failsafe table in the documentation and the tests that explore the machine are derived from
`TRANSITIONS`. No state has a reaction that arms the vehicle or changes its mode.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from aero_planner.plan import PlanStatus


class State(enum.Enum):
    """State of the node."""

    WAITING = "something required for flight is missing, or the pilot flies"
    READY = "everything is in place; the pilot may switch to OFFBOARD"
    WITHDRAWING = "no longer ready; the drone is being stopped in case the pilot has just switched to OFFBOARD"
    FLYING = "the drone follows the plan"
    ARRIVED = "the drone has reached the goal and waits there"
    BRAKING = "something is wrong; the drone is being stopped"
    HOLDING = "the drone is at rest and waits until it can continue"
    HANDED_BACK = "the autopilot has control until the vehicle is disarmed"


class Reaction(enum.Enum):
    """Command that is sent to the autopilot."""

    SILENT = "nothing: the autopilot leaves OFFBOARD through its own failsafe, unless it already has"
    STREAM_PLAN = "the planned controls"
    BRAKE = (
        "controls that stop and level the drone, on its braking path if there is one; by dead reckoning if the vehicle "
        "state is stale"
    )
    BRAKE_AS_PLANNED = "the planned controls, which stop the drone away from obstacles"
    HOLD = "controls that stop the drone and hold its position"


REACTIONS: dict[State, Reaction] = {
    State.WAITING: Reaction.SILENT,
    # PX4 accepts OFFBOARD only while setpoints arrive. It ignores their content until it switches, but then obeys them
    # for up to a second before its next heartbeat reports the switch: they must be harmless.
    State.READY: Reaction.BRAKE,
    State.WITHDRAWING: Reaction.BRAKE,
    State.FLYING: Reaction.STREAM_PLAN,
    State.ARRIVED: Reaction.HOLD,
    State.BRAKING: Reaction.BRAKE,
    State.HOLDING: Reaction.HOLD,
    State.HANDED_BACK: Reaction.SILENT,
}
"""Reaction in each state."""

AS_PLANNED = (Reaction.STREAM_PLAN, Reaction.BRAKE_AS_PLANNED)
"""Reactions that send the planned controls."""


@dataclass(frozen=True)
class Inputs:
    """Facts known at one tick of the control loop. The age of something that has never arrived is infinite [s]."""

    armed: bool
    offboard: bool
    state_age: float
    """Age of the newest finite vehicle state."""
    heartbeat_age: float
    """Age of the autopilot's newest heartbeat."""
    cloud_age: float
    """Age of the newest point."""
    plan_age: float
    """Age of the vehicle state on which the newest finite plan is based."""
    plan_status: PlanStatus
    state_finite: bool
    """True if the newest vehicle state holds neither NaN nor infinity."""
    plan_finite: bool
    """True if the newest plan holds neither NaN nor infinity."""
    in_air: bool | None
    """As reported by the autopilot; None if it does not report it."""
    position_std: float
    """Standard deviation of the position as estimated by the autopilot [m]; NaN if unknown."""
    velocity_std: float
    """The same for the velocity [m/s]."""
    fix_age: float
    """Age of the newest fix of the autopilot's GNSS receiver [s]; NaN if there never was one."""
    drift_angle: float
    """Error of the attitude that the LiDAR has measured in the last seconds [rad]; NaN if it has not."""
    drift_speed: float
    """The same for the velocity [m/s]."""
    inside_fence: bool
    """False below the floor, too."""
    loop_age: float
    """Time since the previous tick began; 0 at the first tick."""
    speed: float
    """[m/s]"""
    goal_distance: float
    """[m]"""
    goal_number: int = 0
    """Number of goals received so far."""
    stopping: bool = False
    """True once the node has been asked to stop."""
    below_floor: bool = False
    """True if the drone is lower than the fence allows."""
    supported: bool = True
    """False if the vehicle is of a kind that must not be commanded."""
    guarded: bool = True
    """False if the failsafe process has ended or hangs; True as well if the node is to fly without one."""
    clock_set: bool = True
    """False if signed messages are required and the computer's date is not set."""
    transmitter_lost: bool = False
    """True if the autopilot no longer hears the pilot's transmitter."""
    battery_low: bool = False
    """True if the autopilot has warned of a low battery."""
    round_trip: float = math.nan
    """Time from a request to the autopilot to its answer [s]; NaN if it is not measured."""
    seen_disarmed: bool = True
    """True once the vehicle has been seen disarmed. `SafetyMachine` fills in this and the next six fields."""
    state_time: float = 0.0
    """Time since the present state was entered [s]."""
    fault_time: float = 0.0
    """Time with faults since the take-over [s]; a fifth of the time without is subtracted."""
    goal_new: bool = False
    """True if the goal differs from the one that was reached last."""
    estimate_was_poor: bool = False
    """True if ESTIMATE_POOR applied at the previous tick."""
    cloud_drifted: bool = False
    """True if CLOUD_DRIFTS applied at the previous tick."""
    link_was_late: bool = False
    """True if LINK_LATE applied at the previous tick."""


class Cause(enum.Enum):
    """Reason for which a state is left."""

    UNSUPPORTED = "the vehicle is anything but a PX4 that flies a multicopter"
    TAKEN_OVER = "the vehicle was disarmed or left OFFBOARD"
    ARMED_AT_START = "the vehicle was already armed when the node started"
    DISARMED = "the vehicle is disarmed"
    ENGAGED = "the pilot switched to OFFBOARD"
    NOT_ENGAGED = "the pilot has not switched to OFFBOARD"
    LINK_LOST = "no heartbeat from the autopilot"
    LINK_LATE = "the link to the autopilot is late: a round trip exceeds limits.round_trip"
    STATE_STALE = "no vehicle state from the autopilot"
    STATE_NOT_FINITE = "the vehicle state contains NaN or infinity"
    FIX_LOST = "the autopilot's GNSS receiver has lost its fix"
    ESTIMATE_POOR = "the autopilot's position or velocity is too uncertain"
    CLOUD_DRIFTS = "the cloud does not stand still: the autopilot's attitude, velocity or time stamps are wrong"
    TRANSMITTER_LOST = "the autopilot no longer hears the pilot's transmitter"
    BATTERY_LOW = "the autopilot has warned of a low battery"
    BELOW_FLOOR = "below the floor, limits.fence_height_min above the ground"
    OUTSIDE_FENCE = "outside the geofence"
    LOOP_STALLED = "the control loop stalled"
    CLOUD_STALE = "no points from the LiDAR: none arrive, or nothing is in range"
    PLAN_NOT_FINITE = "the plan contains NaN or infinity"
    PLAN_STALE = "no plan in time: the planner is late, hangs or fails"
    PLAN_UNSAFE = "no safe candidate, or a plan based on a stale cloud"
    ON_GROUND = "the vehicle is on the ground, taking off or landing"
    IN_AIR_UNKNOWN = "the autopilot does not report whether the vehicle is in the air"
    UNGUARDED = "the failsafe process, which brakes if this one dies, has ended or hangs: start the node again"
    CLOCK_UNSET = "the computer's date is not set, so that old signed messages can't be told from new ones: set it"
    STOPPING = "the node was asked to stop"
    STATE_TIMEOUT = "no vehicle state for too long to continue by dead reckoning"
    LINK_TIMEOUT = "no heartbeat for too long to continue"
    LOOP_TIMEOUT = "the control loop stalled for too long to continue"
    BRAKE_TIMEOUT = "not at rest in time"
    HOLD_TIMEOUT = "no safe way to continue was found in time"
    AT_REST = "at rest"
    GOAL_REACHED = "the goal is reached"
    GOAL_MOVED = "the goal is elsewhere and nothing prevents flying"
    ALL_CLEAR = "nothing prevents flying"
    STANDBY = "nothing prevents flying and the node is not in control"


FAULTS = (
    Cause.LINK_LOST, Cause.STATE_STALE, Cause.STATE_NOT_FINITE, Cause.FIX_LOST, Cause.ESTIMATE_POOR,
    Cause.CLOUD_DRIFTS, Cause.LINK_LATE, Cause.TRANSMITTER_LOST, Cause.BATTERY_LOW, Cause.BELOW_FLOOR,
    Cause.OUTSIDE_FENCE, Cause.LOOP_STALLED, Cause.CLOUD_STALE, Cause.PLAN_NOT_FINITE, Cause.PLAN_STALE,
    Cause.PLAN_UNSAFE,
)  # fmt: skip
"""Causes that prevent flying a plan, the most severe first."""

_LANDED = (Cause.ON_GROUND, Cause.IN_AIR_UNKNOWN)
"""Causes for which the node falls silent at once: the drone is, or may be, on the ground."""

_UNFIT = (Cause.UNGUARDED, Cause.CLOCK_UNSET)

NOT_READY = (Cause.UNSUPPORTED, *_LANDED, *_UNFIT)
"""Causes that, like the faults, prevent READY and the way back to FLYING, but that do not brake a flight."""

REACTION_OVERRIDES: dict[tuple[State, tuple[Cause, ...]], Reaction] = {
    # The controls of an unsafe plan are the planner's own braking candidate, chosen with regard to obstacles.
    (State.BRAKING, (Cause.PLAN_UNSAFE,)): Reaction.BRAKE_AS_PLANNED,
    # The same is true of a stale cloud that the planner knows about: static obstacles are still where it saw them.
    (State.BRAKING, (Cause.CLOUD_STALE, Cause.PLAN_UNSAFE)): Reaction.BRAKE_AS_PLANNED,
}
"""Reaction that replaces the one in `REACTIONS` when exactly these faults are present."""

BLINDING = (Cause.LINK_LOST, Cause.STATE_STALE, Cause.STATE_NOT_FINITE)
"""Faults that leave only dead reckoning."""

LOST = (Cause.FIX_LOST, Cause.ESTIMATE_POOR, Cause.CLOUD_DRIFTS)
"""Faults with which position and velocity drift."""

UNLOCATED = (*BLINDING, *LOST)
"""Faults without a position to hold: the drone is braked, but it does not count as at rest."""

HARMLESS_AT_REST = (Cause.CLOUD_STALE, Cause.PLAN_NOT_FINITE, Cause.PLAN_STALE, Cause.PLAN_UNSAFE)
"""Faults that do not matter to a drone that waits at its goal."""

DETECTION: dict[Cause, tuple[str, ...]] = {
    Cause.LINK_LOST: ("limits.heartbeat_age",),
    Cause.STATE_STALE: ("limits.state_age",),
    Cause.STATE_NOT_FINITE: ("limits.state_age",),  # at the latest: a link that drops such states lets the state age
    Cause.FIX_LOST: ("limits.fix_age",),
    Cause.ESTIMATE_POOR: (),
    Cause.CLOUD_DRIFTS: ("limits.drift_time",),
    Cause.LINK_LATE: ("limits.round_trip_time",),
    Cause.TRANSMITTER_LOST: (),
    Cause.BATTERY_LOW: (),
    Cause.BELOW_FLOOR: (),
    Cause.OUTSIDE_FENCE: (),
    Cause.LOOP_STALLED: ("limits.deadline",),
    Cause.CLOUD_STALE: ("limits.cloud_age",),
    Cause.PLAN_NOT_FINITE: (),
    Cause.PLAN_STALE: ("limits.plan_age",),
    Cause.PLAN_UNSAFE: (),
    Cause.STOPPING: (),
    Cause.UNSUPPORTED: (),
    Cause.TAKEN_OVER: (),
    Cause.STATE_TIMEOUT: ("limits.state_age", "limits.blind_time"),
    Cause.LINK_TIMEOUT: ("limits.heartbeat_age", "limits.blind_time"),
    Cause.LOOP_TIMEOUT: ("limits.deadline", "limits.blind_time"),
    Cause.BRAKE_TIMEOUT: ("limits.brake_time",),
    Cause.HOLD_TIMEOUT: ("limits.brake_time", "limits.hold_time"),
}
"""Settings whose sum is the time from the event to its detection. The reaction follows within one control period."""

THRESHOLDS: dict[Cause, tuple[str, ...]] = {
    Cause.ESTIMATE_POOR: ("limits.position_std", "limits.velocity_std"),
    Cause.BELOW_FLOOR: ("limits.fence_height_min",),
    Cause.OUTSIDE_FENCE: ("limits.fence_*",),
}
"""Settings that define an event itself."""


def reaction_to(state: State, faults: tuple[Cause, ...]) -> Reaction:
    """Return the reaction in `state` while `faults`, in the order of `FAULTS`, are present."""
    return REACTION_OVERRIDES.get((state, faults), REACTIONS[state])


@dataclass(frozen=True)
class Transition:
    """One row of the table: when `cause` applies in one of the `sources`, the next state is `target`."""

    sources: tuple[State, ...]
    cause: Cause
    target: State


_S = State

COMMANDING = (_S.FLYING, _S.ARRIVED, _S.BRAKING, _S.HOLDING)
"""States in which the drone obeys the node."""

MAYBE_COMMANDING = (_S.READY, _S.WITHDRAWING)
"""States in which it may: the autopilot has possibly switched to OFFBOARD since its last heartbeat."""

TRANSITIONS: tuple[Transition, ...] = (
    Transition(COMMANDING, Cause.UNSUPPORTED, _S.HANDED_BACK),
    Transition(MAYBE_COMMANDING, Cause.UNSUPPORTED, _S.WAITING),
    # The watchdog or the failsafe process has braked and handed the drone back. If the reported mode still says
    # OFFBOARD, that may be the autopilot's failsafe on its way.
    Transition(COMMANDING, Cause.LOOP_TIMEOUT, _S.HANDED_BACK),
    Transition(MAYBE_COMMANDING, Cause.LOOP_TIMEOUT, _S.WAITING),
    # The pilot always wins.
    Transition(COMMANDING, Cause.TAKEN_OVER, _S.WAITING),
    Transition((_S.HANDED_BACK, _S.WITHDRAWING), Cause.DISARMED, _S.WAITING),
    Transition((_S.WAITING, *MAYBE_COMMANDING), Cause.ARMED_AT_START, _S.HANDED_BACK),
    # Faults that are too severe or last too long hand the drone back to the autopilot.
    Transition(COMMANDING, Cause.STATE_TIMEOUT, _S.HANDED_BACK),
    Transition(COMMANDING, Cause.LINK_TIMEOUT, _S.HANDED_BACK),
    Transition((_S.BRAKING,), Cause.BRAKE_TIMEOUT, _S.HANDED_BACK),
    Transition((_S.HOLDING,), Cause.HOLD_TIMEOUT, _S.HANDED_BACK),
    Transition((_S.ARRIVED, _S.HOLDING), Cause.STOPPING, _S.HANDED_BACK),
    # The next heartbeat tells whether the drone obeys.
    *(Transition(MAYBE_COMMANDING, cause, _S.WAITING) for cause in _LANDED),
    Transition((_S.WITHDRAWING,), Cause.STATE_TIMEOUT, _S.WAITING),
    Transition((_S.WITHDRAWING,), Cause.LINK_TIMEOUT, _S.WAITING),
    Transition((_S.WITHDRAWING,), Cause.ENGAGED, _S.BRAKING),
    # Faults that are present now.
    *(Transition((_S.READY,), cause, _S.WITHDRAWING) for cause in (Cause.STOPPING, *FAULTS, *_UNFIT)),
    Transition((_S.FLYING,), Cause.STOPPING, _S.BRAKING),
    *(Transition((_S.FLYING,), fault, _S.BRAKING) for fault in FAULTS),
    *(Transition((_S.ARRIVED,), fault, _S.BRAKING) for fault in FAULTS if fault not in HARMLESS_AT_REST),
    *(Transition((_S.HOLDING,), fault, _S.BRAKING) for fault in UNLOCATED),
    # Recovery and progress.
    Transition((_S.BRAKING, _S.HOLDING), Cause.ALL_CLEAR, _S.FLYING),
    Transition((_S.BRAKING,), Cause.AT_REST, _S.HOLDING),
    Transition((_S.FLYING,), Cause.GOAL_REACHED, _S.ARRIVED),
    Transition((_S.ARRIVED,), Cause.GOAL_MOVED, _S.FLYING),
    Transition((_S.READY,), Cause.ENGAGED, _S.FLYING),
    Transition((_S.WAITING, _S.WITHDRAWING), Cause.STANDBY, _S.READY),
    Transition((_S.WITHDRAWING,), Cause.NOT_ENGAGED, _S.WAITING),
)
"""Tried from top to bottom. The first row that applies is taken, at most one per tick."""
