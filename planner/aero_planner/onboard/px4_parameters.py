"""PX4's parameters over MAVLink: the values that the node needs, why, and how they are read and written."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

from aero_planner.check_report import Check
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.settings import OnboardConfig

_TIMEOUT = 2.0  # [s] for an answer
_RETRY_PERIOD = 0.4  # [s] between two requests
_POLL_PERIOD = 0.01  # [s]
_HEARTBEAT_TIMEOUT = 3.0  # [s] for the next heartbeat; PX4 sends one per second
_HEARTBEAT_MAX_AGE = 2.0  # [s] at a write
_POLLS_MAX = 1000  # to read all that has arrived
_MAX_LOSS_TIME = 0.5  # [s]
_CONTROL_PERIODS = 4.0  # in which the failsafe process must have sent its first command
_MAX_HOVER_ERROR = 0.05  # relative
_TOLERANCE = 1e-6

_OVERRIDE_OFFBOARD, _EXCEPT_OFFBOARD = 2, 4  # bits of COM_RC_OVERRIDE and COM_RCL_EXCEPT
_HOLD, _POSITION = 5, 0  # values of COM_OBL_RC_ACT
_MAX_CRITICAL = 0.1  # charge; BAT_LOW_THR is 0.12 or more
_MIN_FAILSAFE_DELAY = 3.0  # [s] in which PX4's Hold stops the drone from 5 m/s


@dataclass(frozen=True)
class _Wanted:
    """Requirement of the node on a parameter."""

    name: str
    wanted: str
    """The accepted values in words."""
    reason: str
    accepts: Callable[[float], bool]
    repair: Callable[[float], float] | None = None
    """Returns the value to write instead of a wrong one; None if only the user can know it."""
    required: bool = True


@dataclass(frozen=True)
class _Failsafe:
    """One of PX4's failsafes that act in OFFBOARD, too."""

    name: str
    """The parameter that holds its action."""
    event: str
    actions: dict[int, str]
    """The accepted actions in words, by value; the others return or end the flight."""
    repair: int | None
    """The value to write instead of another one; None leaves the choice to the user."""


_FAILSAFES = (
    _Failsafe("NAV_RCL_ACT", "the transmitter is lost in a mode other than OFFBOARD", {1: "Hold", 3: "Land"}, 1),
    _Failsafe("NAV_DLL_ACT", "the ground station is lost", {0: "none", 1: "Hold", 3: "Land"}, 0),
    _Failsafe("COM_LOW_BAT_ACT", "the battery is critical", {0: "warning", 2: "Land"}, None),
    _Failsafe("COM_FLTT_LOW_ACT", "the battery only suffices for the way back", {0: "none", 1: "warning"}, 1),
    _Failsafe("COM_FLT_TIME_MAX", "the longest flight time [s] is over", {-1: "no limit"}, -1),
    _Failsafe("GF_ACTION", "its own geofence is left", {0: "none", 1: "warning", 2: "Hold", 5: "Land"}, 2),
    _Failsafe("COM_WIND_MAX_ACT", "the wind is strong", {0: "none", 1: "warning", 2: "Hold", 5: "Land"}, 1),
    _Failsafe("COM_IMB_PROP_ACT", "a propeller vibrates", {-1: "none", 0: "warning", 2: "Land"}, 0),
    _Failsafe("COM_ACT_FAIL_ACT", "a motor fails", {0: "warning", 1: "Hold", 2: "Land"}, 0),
)


@dataclass(frozen=True)
class ParameterChange:
    """A parameter to be written."""

    name: str
    value: float
    """The value to write; whole numbers for integers."""
    before: float
    """The present value."""


@dataclass(frozen=True)
class WriteResult:
    """Result of writing parameters."""

    unconfirmed: tuple[str, ...]
    """Names of those that the autopilot has not confirmed."""
    refusal: str = ""
    """Why writing ended before all of them were sent, such as "the vehicle is armed"; empty if it did not."""


class _WriteRefusedError(Exception):
    """Nothing may be written now; the message says why."""


def read_parameters(
    link: MavlinkLink,
    names: Collection[str],
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> dict[str, float]:
    """Return the values of those parameters that the autopilot reports within two seconds."""
    for name in names:
        link.parameters.pop(name, None)
    _request(link, names, lambda name: link.request_parameter(name), clock, sleep)
    return {name: link.parameters[name] for name in names if name in link.parameters}


def write_parameters(
    link: MavlinkLink,
    changes: Sequence[ParameterChange],
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> WriteResult:
    """Write parameters while the vehicle is disarmed.

    The first one is sent only after a heartbeat that is newer than this call, and each one only while the newest
    heartbeat says that the vehicle is disarmed.
    """
    values = {change.name: change.value for change in changes}
    for name in values:
        link.parameters.pop(name, None)

    def send(name: str) -> None:
        _check_disarmed(link, clock)
        link.set_parameter(name, values[name])

    refusal = ""
    try:
        _await_heartbeat(link, clock, sleep)
        _request(link, values, send, clock, sleep)
    except _WriteRefusedError as error:
        refusal = str(error)
    unconfirmed = tuple(
        name for name, value in values.items()
        if not math.isclose(link.parameters.get(name, math.nan), value, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE)
    )  # fmt: skip
    return WriteResult(unconfirmed, refusal if unconfirmed else "")


def check_parameters(values: dict[str, float], onboard: OnboardConfig) -> Iterator[Check]:
    """Compare the parameters that the autopilot reported with those that the node needs."""
    for wanted in _wanted(onboard):
        if wanted.name not in values:
            advice = f"Check by hand that it is {wanted.wanted}: {wanted.reason}"
            yield Check(wanted.name, "not reported", ok=False, required=False, advice=advice)
            continue
        value = values[wanted.name]
        advice = wanted.reason
        if wanted.repair is not None:
            advice += f" Set it to {wanted.repair(value):g}, or run preflight with --set."
        finding = f"{value:g}; wanted: {wanted.wanted}"
        yield Check(wanted.name, finding, ok=wanted.accepts(value), required=wanted.required, advice=advice)


def find_changes(values: dict[str, float], onboard: OnboardConfig) -> list[ParameterChange]:
    """Return the changes that turn the reported parameters into those that the node needs."""
    return [
        ParameterChange(wanted.name, wanted.repair(values[wanted.name]), values[wanted.name])
        for wanted in _wanted(onboard)
        if wanted.repair is not None and wanted.name in values and not wanted.accepts(values[wanted.name])
    ]


def parameter_names(onboard: OnboardConfig) -> list[str]:
    """Return the names of the parameters that are checked."""
    return [wanted.name for wanted in _wanted(onboard)]


def _without_detour(failsafe: _Failsafe) -> _Wanted:
    """Return the requirement that a failsafe does not return."""
    *others, last = (f"{value} ({action})" for value, action in failsafe.actions.items())
    reason = f"What PX4 does when {failsafe.event}: Return first climbs to 30 m by default, through the trees."
    repair = failsafe.repair
    return _Wanted(
        failsafe.name,
        f"{', '.join(others)} or {last}" if others else last,
        reason if repair is not None else f"{reason} Choose by hand: after a mere warning, it flies on until it falls.",
        lambda value: value in failsafe.actions,
        None if repair is None else lambda _: repair,
    )


def _wanted(onboard: OnboardConfig) -> list[_Wanted]:
    shortest = onboard.limits.deadline + _CONTROL_PERIODS / onboard.rates.control
    loss_time = max(0.2, shortest)
    hover, curve = onboard.thrust.hover_thrust, onboard.thrust.curve
    wanted = [
        _Wanted(
            "COM_OF_LOSS_T",
            f"{shortest:g} to {max(_MAX_LOSS_TIME, loss_time):g} s",
            "For this time PX4 blindly obeys the last command after the stream ends; a shorter one is less than the "
            "failsafe process may need.",
            lambda value: shortest - _TOLERANCE <= value <= max(_MAX_LOSS_TIME, loss_time) + _TOLERANCE,
            lambda _: loss_time,
        ),
        _Wanted(
            "COM_OBL_RC_ACT",
            "5 (Hold) or 0 (Position)",
            "What PX4 does after this time: it must stop the drone, without a detour.",
            lambda value: value in (_HOLD, _POSITION),
            lambda _: _HOLD,
        ),
        _Wanted(
            "COM_RC_OVERRIDE",
            "bit 1 set",
            "The sticks must take over in OFFBOARD as well.",
            lambda value: bool(int(value) & _OVERRIDE_OFFBOARD),
            lambda value: int(value) | _OVERRIDE_OFFBOARD,
        ),
        _Wanted(
            "COM_RCL_EXCEPT",
            "bit 2 set",
            "When the transmitter is lost, the node stops the drone where it sees, and then hands it over: otherwise "
            "PX4 holds it in full flight, without regard to obstacles.",
            lambda value: bool(int(value) & _EXCEPT_OFFBOARD),
            lambda value: int(value) | _EXCEPT_OFFBOARD,
        ),
        *map(_without_detour, _FAILSAFES),
        _Wanted(
            "BAT_CRIT_THR",
            f"{_MAX_CRITICAL:g} or less",
            "PX4 acts at this charge, in full flight; the node stops the drone at BAT_LOW_THR, which must come a "
            "minute before.",
            lambda value: value <= _MAX_CRITICAL + _TOLERANCE,
            required=False,
        ),
        _Wanted(
            "COM_FAIL_ACT_T",
            f"{_MIN_FAILSAFE_DELAY:g} s or more",
            "For this time PX4 holds the drone before it lands or returns, and warns the pilot, who can take over: the "
            "drone must have come to rest.",
            lambda value: value >= _MIN_FAILSAFE_DELAY,
            lambda _: 5.0,
            required=False,
        ),
        _Wanted(
            "THR_MDL_FAC",
            "any value" if curve == 0.0 else "0, because thrust.curve is not",
            "A curve that both PX4 and the node compensate gives the wrong thrust: set thrust.curve to 0.",
            lambda value: curve == 0.0 or value == 0.0,
        ),
        _Wanted(
            "MPC_THR_HOVER",
            f"{hover:g}, as thrust.hover_thrust",
            "Set thrust.hover_thrust to the measured hover thrust: with one that is 10 % wrong, the drone climbs or "
            "sinks at 1 m/s^2.",
            lambda value: abs(value - hover) <= _MAX_HOVER_ERROR * hover,
            required=False,
        ),
    ]
    if "@autopilot" in onboard.mavlink.goal_senders:
        wanted.append(
            _Wanted(
                "MAV_1_FORWARD",
                "1, if the node is connected to TELEM 2 by MAV_1_CONFIG",
                "Without it, PX4 does not forward the goals of a ground station.",
                lambda value: value == 1,
                required=False,
            )
        )
    return wanted


def _request(
    link: MavlinkLink,
    names: Collection[str],
    send: Callable[[str], object],
    clock: Callable[[], float],
    sleep: Callable[[float], object],
) -> None:
    """Call `send` for each name, repeatedly until the autopilot has answered or time is up."""
    end, next_try = clock() + _TIMEOUT, -math.inf
    while clock() < end and (missing := [name for name in names if name not in link.parameters]):
        if clock() >= next_try:
            next_try = clock() + _RETRY_PERIOD
            for name in missing:
                send(name)
        sleep(_POLL_PERIOD)
        link.poll()


def _await_heartbeat(link: MavlinkLink, clock: Callable[[], float], sleep: Callable[[float], object]) -> None:
    """Wait for a heartbeat that is sent from now on; raises `_WriteRefusedError` if none arrives."""
    _read_all(link)  # what has waited, for example while the user was asked, counts as having arrived before
    start = clock()
    while link.state is None or link.state.heartbeat_time <= start:
        if clock() - start > _HEARTBEAT_TIMEOUT:
            raise _WriteRefusedError("whether the vehicle is armed is unknown, since no heartbeat arrives")
        sleep(_POLL_PERIOD)
        link.poll()


def _check_disarmed(link: MavlinkLink, clock: Callable[[], float]) -> None:
    """Raise `_WriteRefusedError` unless a recent heartbeat, the newest that has arrived, says that it is disarmed."""
    _read_all(link)
    if link.state is None or link.state.armed:
        raise _WriteRefusedError("the vehicle is armed")
    age = clock() - link.state.heartbeat_time
    if age > _HEARTBEAT_MAX_AGE:
        raise _WriteRefusedError(f"whether the vehicle is armed is unknown, since its heartbeat is {age:.1f} s old")


def _read_all(link: MavlinkLink) -> None:
    """Read all messages that have arrived, of which a poll reads a part."""
    for _ in range(_POLLS_MAX):
        link.poll()
        if link.is_drained:
            return
    raise _WriteRefusedError("whether the vehicle is armed is unknown, since messages arrive faster than they are read")
