"""The state of the vehicle from the autopilot's messages.

It comes from ODOMETRY or, while no usable one arrives, from LOCAL_POSITION_NED with ATTITUDE_QUATERNION. The estimator
counts as reset when the reset counter of ODOMETRY changes, when LOCAL_POSITION_NED, which has no counter, moves as no
flight does (`aero_planner.onboard.estimator_reset`), and when the state begins to come from the other message. The
covariances of ODOMETRY tell how uncertain the state is; the other two messages have none.

HEARTBEAT tells what the vehicle is and whether it is armed and in OFFBOARD, EXTENDED_SYS_STATE whether it is in the
air, GPS_RAW_INT whether GNSS has a fix, SYS_STATUS whether the pilot's transmitter is heard, BATTERY_STATUS whether a
battery is low. A DISTANCE_SENSOR that looks down measures the height of the ground. Answers to TIMESYNC tell how late
all of these are.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.estimator_reset import EstimatorState, is_estimator_reset
from aero_planner.onboard.frames import attitude_from_ned, world_from_ned
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.round_trips import RoundTrips
from aero_planner.plan import VehicleState
from aero_planner.quaternions import integrate_rates, rotate

_log = logging.getLogger(__name__)

COORDINATE_LIMIT = 1e6
"""Largest coordinate [m] and velocity [m/s]; larger values have no precision left in float32."""

_ODOMETRY_TIMEOUT = 1.0  # [s] without ODOMETRY after which the other two messages are used
_PAIR_TIMEOUT = 0.1  # [s] between the stamps of a position and an attitude that are used together
_OVERTAKEN = 1.0  # [s] by which an attitude may be late and is ignored; more means that the clock was set
_RANGE_TIMEOUT = 1.0  # [s] after which a measured distance counts no more
_RANGE_MAX_TILT = 0.5  # [rad] beyond which a distance to the ground is not used
_INVALID_QUALITY = 1  # signal_quality of a distance that is not valid
_LANDED_TIMEOUT = 3.0  # [s] after which a report that the vehicle is in the air, or is not, counts no more
_DO_ORBIT = 34  # MAV_CMD_DO_ORBIT, whose name older versions of pymavlink lack
_TRANSMITTER_TIMEOUT = 3.0  # [s] after which a report that the transmitter is heard counts no more
_PX4_OFFBOARD = 6  # main mode, bits 16 to 23 of a heartbeat's custom_mode
_MULTICOPTERS = (
    "TRICOPTER", "QUADROTOR", "HEXAROTOR", "OCTOROTOR", "DECAROTOR", "DODECAROTOR", "GENERIC_MULTIROTOR",
)  # fmt: skip
"""Vehicles, by their MAV_TYPE, that a thrust and body rates steer."""


_MODE_TIMEOUT = 0.1  # [s] after an accepted change of the mode in which a heartbeat must name the new one


class StateReceiver:
    """Combines the autopilot's messages to samples of the vehicle state.

    Args:
        clock: Host time [s].
        round_trip_time: Time over which round trips are measured [s].

    Attributes:
        round_trips: What TIMESYNC has measured.
        sample: The newest sample; None before the first state. Heartbeats update its flags between two states.
        kind: What the vehicle says it is, such as "PX4 QUADROTOR"; None before its first heartbeat.
        supported: False once it has said that it is anything but a PX4 that flies a multicopter. It stays so, with
            that `kind`: a vehicle does not change, so another one with the same ids has been heard.
        dropped: Number of states that could not be used, by message and reason.
    """

    MESSAGES = (
        "HEARTBEAT", "ODOMETRY", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE", "DISTANCE_SENSOR",
        "GPS_RAW_INT", "SYS_STATUS", "BATTERY_STATUS", "COMMAND_ACK", "TIMESYNC",
    )  # fmt: skip
    """Names of the messages that `process` takes."""

    def __init__(self, clock: Callable[[], float], round_trip_time: float = 1.0) -> None:
        self.round_trips = RoundTrips(round_trip_time)
        self.sample: VehicleSample | None = None
        self.kind: str | None = None
        self.supported = True
        self.dropped: dict[str, int] = {}
        self._time = clock
        self._dialect = load_dialect()
        self._handlers: dict[str, Callable[[Any], bool]] = {
            "HEARTBEAT": self._process_heartbeat,
            "ODOMETRY": self._process_odometry,
            "ATTITUDE_QUATERNION": self._process_attitude,
            "LOCAL_POSITION_NED": self._process_position,
            "EXTENDED_SYS_STATE": self._process_landed_state,
            "DISTANCE_SENSOR": self._process_distance,
            "GPS_RAW_INT": self._process_fix,
            "SYS_STATUS": self._process_system_status,
            "BATTERY_STATUS": self._process_battery,
            "COMMAND_ACK": self._process_acknowledgement,
            "TIMESYNC": self._process_round_trip,
        }
        self._mode_changed = np.inf  # when a change of the mode was accepted that no heartbeat has named yet
        self._mode_commands = _mode_commands(self._dialect)
        self._clocks = {name: HostClock() for name in ("ODOMETRY", "LOCAL_POSITION_NED")}
        self._armed = self._offboard = False
        self._heartbeat_time = self._odometry_time = -np.inf
        self._landed_state, self._landed_time = 0, -np.inf
        self._position_std = self._velocity_std = math.nan
        self._ground_height, self._range_time = math.nan, -np.inf
        self._fix_time = math.nan
        self._transmitter_time: float | None = None  # when the transmitter was last reported as present
        self._low_batteries: set[int] = set()  # their numbers
        self._attitude: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
        self._estimate: EstimatorState | None = None
        self._origin: tuple[Any, ...] | None = None
        self._resets = self._detected_resets = 0

    def process(self, message: Any) -> bool:
        """Process one of the autopilot's messages; return False if it could not be used."""
        return self._handlers[message.get_type()](message)

    def _process_heartbeat(self, message: Any) -> bool:
        self._heartbeat_time = self._time()
        self._armed = bool(message.base_mode & self._dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        if self.supported:
            self._identify(message)
        self._mode_changed = np.inf
        custom = message.base_mode & self._dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._offboard = bool(custom) and message.custom_mode >> 16 & 0xFF == _PX4_OFFBOARD
        self._update_flags()
        return True

    @property
    def is_armed(self) -> bool:
        """True if the newest heartbeat says that the vehicle is armed."""
        return self._armed

    @property
    def is_mode_unknown(self) -> bool:
        """True if somebody has changed the mode, and no heartbeat has told since what it is."""
        return self._mode_changed < np.inf

    def _process_acknowledgement(self, message: Any) -> bool:
        if message.command in self._mode_commands and message.result == self._dialect.MAV_RESULT_ACCEPTED:
            self._mode_changed = min(self._mode_changed, self._time())
        return True

    def _process_round_trip(self, message: Any) -> bool:
        is_answer = self.round_trips.answer(message.tc1, message.ts1, self._time())
        self._update_flags()
        return is_answer

    def _identify(self, message: Any) -> None:
        autopilot = _enum_name(self._dialect, "MAV_AUTOPILOT", message.autopilot)
        vehicle = _enum_name(self._dialect, "MAV_TYPE", message.type)
        self.supported = autopilot == "PX4" and vehicle in _MULTICOPTERS
        kind = f"{autopilot} {vehicle}"
        if not self.supported:
            _log.error("the vehicle is a %s, and only a PX4 that flies a multicopter is commanded", kind)
        self.kind = kind

    def _process_landed_state(self, message: Any) -> bool:
        self._landed_state, self._landed_time = message.landed_state, self._time()
        self._update_flags()
        return True

    def _process_distance(self, message: Any) -> bool:
        now = self._time()
        if self.sample is None or now - self.sample.time > _RANGE_TIMEOUT:
            return True
        is_downward = message.orientation == self._dialect.MAV_SENSOR_ROTATION_PITCH_270
        is_in_range = message.min_distance < message.current_distance < message.max_distance
        upright = float(rotate(self.sample.state.quaternion, [0.0, 0.0, 1.0])[2])
        if not is_downward or not is_in_range or message.signal_quality == _INVALID_QUALITY:
            return True
        if upright > math.cos(_RANGE_MAX_TILT):
            height = float(np.asarray(self.sample.state.position)[2])
            self._ground_height, self._range_time = height - 1e-2 * message.current_distance * upright, now
            self._update_flags()
        return True

    def _process_fix(self, message: Any) -> bool:
        if message.fix_type >= self._dialect.GPS_FIX_TYPE_3D_FIX:
            self._fix_time = self._time()
            self._update_flags()
        return True

    def _process_system_status(self, message: Any) -> bool:
        # PX4 counts a remote control as present while it hears it: rcAndDataLinkCheck.cpp.
        if message.onboard_control_sensors_present & self._dialect.MAV_SYS_STATUS_SENSOR_RC_RECEIVER:
            self._transmitter_time = self._time()
        elif self._transmitter_time is not None:
            self._transmitter_time = -np.inf
        self._update_flags()
        return True

    def _process_battery(self, message: Any) -> bool:
        d = self._dialect
        if d.MAV_BATTERY_CHARGE_STATE_LOW <= message.charge_state <= d.MAV_BATTERY_CHARGE_STATE_UNHEALTHY:
            self._low_batteries.add(message.id)
        elif not self._armed:  # in flight, a warning stays
            self._low_batteries.discard(message.id)
        self._update_flags()
        return True

    def _process_odometry(self, message: Any) -> bool:
        d = self._dialect
        arrival = self._time()
        attitude = _normalized(message.q)
        velocity = np.array([message.vx, message.vy, message.vz])
        local = d.MAV_FRAME_LOCAL_NED, d.MAV_FRAME_LOCAL_FRD
        body = message.child_frame_id in (d.MAV_FRAME_BODY_FRD, d.MAV_FRAME_BODY_NED)
        if message.frame_id not in local or not (body or message.child_frame_id in local):
            return self._drop(f"ODOMETRY in frames {message.frame_id} and {message.child_frame_id}")
        if attitude is None or not np.isfinite(velocity).all():
            return self._drop(f"ODOMETRY that is not finite or beyond {COORDINATE_LIMIT:g}")
        if body:
            velocity = rotate(attitude, velocity)
        time = self._host_time("ODOMETRY", 1e-6 * message.time_usec, arrival)
        origin = "ODOMETRY", message.frame_id, message.reset_counter
        stds = _largest_std(message.pose_covariance), _largest_std(message.velocity_covariance)
        if self._set_state(origin, time, [message.x, message.y, message.z], velocity, attitude, stds):
            self._odometry_time = arrival
            return True
        return False

    def _process_attitude(self, message: Any) -> bool:
        stamp, attitude = 1e-3 * message.time_boot_ms, _normalized([message.q1, message.q2, message.q3, message.q4])
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        if attitude is None or not np.isfinite(rates).all():
            self._drop("ATTITUDE_QUATERNION that is not finite")
        elif self._attitude is None or not 0.0 <= self._attitude[0] - stamp < _OVERTAKEN:
            self._attitude = stamp, attitude, rates
            return True
        return False

    def _process_position(self, message: Any) -> bool:
        arrival, stamp = self._time(), 1e-3 * message.time_boot_ms
        if arrival - self._odometry_time < _ODOMETRY_TIMEOUT or self._attitude is None:
            return False
        # Both stamps are from the same clock.
        attitude_stamp, attitude, rates = self._attitude
        if abs(stamp - attitude_stamp) > _PAIR_TIMEOUT:
            return False
        time = self._host_time("LOCAL_POSITION_NED", stamp, arrival)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        attitude = integrate_rates(attitude, rates, stamp - attitude_stamp)
        estimate = EstimatorState(stamp, position, velocity, attitude, rates)
        before = self._estimate
        is_reset = before is not None and _is_usable(position, velocity) and is_estimator_reset(before, estimate)
        resets = self._detected_resets + is_reset
        if self._set_state(("LOCAL_POSITION_NED", resets), time, position, velocity, attitude):
            self._estimate, self._detected_resets = estimate, resets
            return True
        return False

    def _host_time(self, name: str, stamp: float, arrival: float) -> float | None:
        return self._clocks[name].to_host(stamp, arrival, max_offset=self.round_trips.max_offset(arrival))

    def _set_state(
        self,
        origin: tuple[Any, ...],
        time: float | None,
        position: ArrayLike,
        velocity: ArrayLike,
        attitude: ArrayLike,
        stds: tuple[float, float] = (math.nan, math.nan),
    ) -> bool:
        """Accept a state in north-east-down; return False if it is unusable or not newer than the present one.

        `origin`, which begins with the message's name, identifies the local origin of the state. When it changes, the
        estimator was reset. `stds` are the standard deviations of position and velocity; NaN stands for unknown.
        """
        p, v, q = world_from_ned(position), world_from_ned(velocity), attitude_from_ned(attitude)
        if time is None:
            return self._drop(f"{origin[0]} with an inconsistent time stamp")
        if not _is_usable(p, v):
            return self._drop(f"{origin[0]} that is not finite or beyond {COORDINATE_LIMIT:g}")
        if self.sample is not None and time <= self.sample.time:
            return False
        self._resets += self._origin not in (None, origin)
        self._origin = origin
        self._position_std, self._velocity_std = stds
        self.sample = self._make_sample(time, VehicleState(p, v, q, time=time))
        return True

    def _make_sample(self, time: float, state: VehicleState) -> VehicleSample:
        in_air = None
        if self._time() - self._landed_time <= _LANDED_TIMEOUT and self._landed_state:
            in_air = self._landed_state == self._dialect.MAV_LANDED_STATE_IN_AIR
        offboard = self._offboard and not self._time() - self._mode_changed >= _MODE_TIMEOUT
        return VehicleSample(
            time, state, self._armed, offboard, self._heartbeat_time, self._resets, in_air,
            self._position_std, self._velocity_std, self._fix_time,
            self._ground_height if self._time() - self._range_time <= _RANGE_TIMEOUT else math.nan,
            self.supported,
            None if self._transmitter_time is None else self._time() - self._transmitter_time <= _TRANSMITTER_TIMEOUT,
            bool(self._low_batteries), self.round_trips.median(self._time()),
        )  # fmt: skip

    def _update_flags(self) -> None:
        """Give the newest sample the present flags."""
        if self.sample is not None:
            self.sample = self._make_sample(self.sample.time, self.sample.state)

    def _drop(self, reason: str) -> bool:
        self.dropped[reason] = self.dropped.get(reason, 0) + 1
        return False


def _is_usable(position: NDArray[np.float64], velocity: NDArray[np.float64]) -> bool:
    """Return True if no coordinate of position or velocity, shape [3] each, is beyond the limit or NaN."""
    # Written so that NaN fails.
    return bool(np.abs(position).max() <= COORDINATE_LIMIT and np.abs(velocity).max() <= COORDINATE_LIMIT)


def _largest_std(covariance: Sequence[float]) -> float:
    """Return the largest standard deviation of x, y and z in the upper triangle of a 6 x 6 matrix; NaN if unknown.

    An autopilot that does not know a variance sends NaN or 0.
    """
    known = [variance for variance in (covariance[0], covariance[6], covariance[11]) if variance > 0.0]
    return math.sqrt(max(known)) if known else math.nan


def _mode_commands(dialect: Any) -> frozenset[int]:
    """Return the commands that change the mode of a PX4, or disarm it."""
    names = (
        "DO_SET_MODE", "COMPONENT_ARM_DISARM", "NAV_TAKEOFF", "NAV_LAND", "NAV_RETURN_TO_LAUNCH", "MISSION_START",
        "DO_REPOSITION", "DO_FLIGHTTERMINATION",
    )  # fmt: skip
    return frozenset((_DO_ORBIT, *(getattr(dialect, f"MAV_CMD_{name}") for name in names)))


def _enum_name(dialect: Any, enum: str, value: int) -> str:
    """Return the name of a value without the enum's prefix, such as "QUADROTOR"; the number itself if it has none."""
    entry = dialect.enums[enum].get(value)
    return str(value) if entry is None else entry.name.removeprefix(f"{enum}_")


def _normalized(quaternion: ArrayLike) -> NDArray[np.float64] | None:
    """Return the unit quaternion [4]; None if the length is far from 1 or NaN."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(q))
    return q / length if 0.9 < length < 1.1 else None
