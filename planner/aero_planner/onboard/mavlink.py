"""The autopilot over MAVLink 2: receives vehicle state, heartbeat and goal; sends thrust and body rates.

The state comes from ODOMETRY or, while no usable one arrives, from LOCAL_POSITION_NED with ATTITUDE_QUATERNION. The
estimator counts as reset when the reset counter of ODOMETRY changes, when LOCAL_POSITION_NED, which has no counter,
moves as no flight does (`aero_planner.onboard.estimator_reset`), and when the state begins to come from the other
message. A goal comes from SET_POSITION_TARGET_LOCAL_NED addressed to this component.

The first autopilot that is heard, with the system id of the settings, is obeyed for good: messages from elsewhere are
ignored, except for goals from the senders that the settings name.

EXTENDED_SYS_STATE tells whether the vehicle is in the air. A DISTANCE_SENSOR that looks down measures the height of the
ground. The covariances of ODOMETRY tell how uncertain the state is; the other two messages have none.

Besides commands (`MavlinkSender`), only a heartbeat per second and requests for messages are
sent: nothing here can arm the vehicle or switch its mode.
"""

from __future__ import annotations

import logging
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.estimator_reset import EstimatorState, is_estimator_reset
from aero_planner.onboard.frames import attitude_from_ned, attitude_to_ned, frd_from_flu, world_from_ned
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.mavlink_parser import MavlinkParser
from aero_planner.onboard.mavlink_signing import SignatureChecker, signing_time
from aero_planner.onboard.thrust import ThrustModel
from aero_planner.onboard.transport import Transport, open_transport
from aero_planner.plan import VehicleState
from aero_planner.quaternions import integrate_rates, rotate

__all__ = ["MavlinkLink", "MavlinkSender", "load_dialect"]

_log = logging.getLogger(__name__)

_ODOMETRY_TIMEOUT = 1.0  # [s] without ODOMETRY after which the other two messages are used
_PAIR_TIMEOUT = 0.1  # [s] between the stamps of a position and an attitude that are used together
_OVERTAKEN = 1.0  # [s] by which an attitude may be late and is ignored; more means that the clock was set
_REQUEST_PERIOD = 2.0  # [s] between two requests for messages
_LANDED_RATE = 5.0  # [Hz] of EXTENDED_SYS_STATE
_RANGE_RATE = 10.0  # [Hz] of DISTANCE_SENSOR
_RANGE_TIMEOUT = 1.0  # [s] after which a measured distance counts no more
_RANGE_MAX_TILT = 0.5  # [rad] beyond which a distance to the ground is not used
_INVALID_QUALITY = 1  # signal_quality of a distance that is not valid
_LANDED_TIMEOUT = 3.0  # [s] after which a report that the vehicle is in the air, or is not, counts no more
_PX4_OFFBOARD = 6  # main mode, bits 16 to 23 of a heartbeat's custom_mode
_LIMIT = 1e6  # [m], [m/s]; larger values have no precision left in float32
_DATAGRAMS_PER_POLL = 128  # twenty times as many as arrive in a control period
_POLL_TIME = 0.004  # [s] of processor time that a poll may take; what is left waits in the socket
_GOAL = "SET_POSITION_TARGET_LOCAL_NED"
_WANTED = (
    "HEARTBEAT", "ODOMETRY", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE", "DISTANCE_SENSOR",
    "PARAM_VALUE", _GOAL,
)  # fmt: skip
_PARAMETERS_MAX = 5000
_FLOAT, _INTEGER = struct.Struct("<f"), struct.Struct("<i")
_IGNORED_MAX = 20  # kinds of ignored messages that are told apart


def load_dialect() -> Any:
    """Return pymavlink's module of the common messages.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise ImportError(
            "MAVLink needs pymavlink, which is not installed; run: pip install 'aero-planner[mavlink]'."
        ) from error
    return common


class MavlinkSender:
    """Packs commands and other messages and sends them; implements `aero_planner.onboard.interfaces.CommandSink`.

    Args:
        transport: Connection to the autopilot; None sends nothing. It may be replaced at any time.
        system: System id of the autopilot and of this computer.
        component: Component id of this computer.
        thrust: Thrust model of the vehicle.
        clock: Host time [s].
        key: Key with which every message is signed, 32 bytes; None signs none.
        link_id: Number of the connection in the signatures; each sender has its own.

    Raises:
        ImportError: pymavlink is not installed.

    Attributes:
        transport: Connection to the autopilot.
        sent: Number of commands sent.
        min_signing_time: Earliest time stamp of the next signature, see `aero_planner.onboard.mavlink_signing`. The
            autopilot accepts none that is much older than its own clock.
    """

    def __init__(
        self,
        transport: Transport | None,
        *,
        system: int,
        component: int,
        thrust: ThrustModel,
        clock: Callable[[], float] = time.monotonic,
        key: bytes | None = None,
        link_id: int = 0,
    ) -> None:
        self.transport = transport
        self.sent = 0
        self.min_signing_time = 0
        self._dialect = load_dialect()
        self._system = system
        self._component = component
        self._thrust = thrust
        self._time = clock
        self._packer = self._dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._sending = threading.Lock()
        self._signing = self._packer.signing
        self._signing.secret_key, self._signing.link_id = key, link_id
        self._signing.sign_outgoing = key is not None

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up. Never blocks.

        Args:
            command: Thrust and rates.
            attitude: Attitude to which the rates turn, body to world, w x y z, shape [4]. PX4 turns to it by
                itself, but only after 0.4 s, in which it follows the rates. None sends rates alone.

        Raises:
            ValueError: The command has another shape or is not finite; nothing was sent.
        """
        values = np.asarray(command, dtype=np.float64)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise ValueError(f"the command is {values.tolist()}; it must be a thrust and three rates, all finite.")
        thrust = self._thrust.signal(float(values[0]))
        rates = frd_from_flu(values[1:])
        message = self._dialect.MAVLink_set_attitude_target_message(
            int(1e3 * self._time()) & 0xFFFFFFFF,
            self._system,
            self._dialect.MAV_COMP_ID_AUTOPILOT1,
            self._dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE if attitude is None else 0,
            [1.0, 0.0, 0.0, 0.0] if attitude is None else attitude_to_ned(attitude).tolist(),
            *rates.tolist(),
            thrust,
        )
        self.sent += self.send_message(message)

    def send_message(self, message: Any) -> bool:
        """Send one of the dialect's messages; return False if there is no transport or no room."""
        with self._sending:
            self._signing.timestamp = max(self._signing.timestamp, self.min_signing_time, signing_time())
            data = message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256
            return self.transport is not None and self.transport.send(bytes(data))


class MavlinkLink(MavlinkSender):
    """A connection to an autopilot that speaks MAVLink; implements `aero_planner.onboard.interfaces.VehicleLink`.

    Args:
        url: See `aero_planner.onboard.transport.open_transport`.
        thrust: Thrust model of the vehicle.
        baud: Baud rate of a serial device [bit/s].
        system: System id of the autopilot and of this computer.
        component: Component id of this computer.
        state_rate: ODOMETRY messages per second that are requested from the autopilot; 0 requests no messages.
        goal_senders: System id and address of each sender of goals; None for the address stands for the autopilot's
            connection.
        key: Key of the signatures, 32 bytes; messages without a valid one are ignored. None accepts all.
        clock: Host time [s].

    Raises:
        ImportError: pymavlink is not installed.
        ValueError, OSError: See `open_transport`.

    Attributes:
        state: See `VehicleLink`.
        goal: See `VehicleLink`.
        parser: Parser of what is received, with its counters.
        received: Number of messages used, by name.
        dropped: Number of states and goals that could not be used, by message and reason.
        parameters: Values of the autopilot's parameters that have arrived, by name; integers, too, in PX4's encoding.
        is_px4: True if the autopilot says that it is a PX4; None before its first heartbeat.
        ignored: Number of messages that were ignored because of their sender, by kind and sender.
    """

    def __init__(
        self,
        url: str,
        thrust: ThrustModel,
        *,
        baud: int = 921_600,
        system: int = 1,
        component: int = 191,
        state_rate: float = 100.0,
        goal_senders: Collection[tuple[int, str | None]] | None = None,
        key: bytes | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        load_dialect()  # raises before the transport is opened
        senders = ((system, None),) if goal_senders is None else goal_senders
        self._goal_senders = frozenset((number, host and socket.gethostbyname(host)) for number, host in senders)
        hosts = {host for _, host in self._goal_senders if host is not None}
        self._transport = open_transport(url, baud=baud, allowed=hosts)
        super().__init__(self._transport, system=system, component=component, thrust=thrust, clock=clock, key=key)
        self._signatures = None if key is None else SignatureChecker(key)
        self.parser = MavlinkParser(
            self._dialect,
            datagrams=self._transport.datagrams,
            wanted=_WANTED,
            systems={system, *(sender for sender, _ in self._goal_senders)},
            signatures=self._signatures,
        )
        self._state_rate = state_rate
        self._polling = threading.Lock()
        self.state: VehicleSample | None = None
        self.goal: NDArray[np.float64] | None = None
        self.received: dict[str, int] = {}
        self.dropped: dict[str, int] = {}
        self.ignored: dict[str, int] = {}
        self.parameters: dict[str, float] = {}
        self.is_px4: bool | None = None
        self._integers: set[str] = set()
        self._clocks = {name: HostClock() for name in ("ODOMETRY", "LOCAL_POSITION_NED")}
        self._armed = self._offboard = False
        self._heartbeat_time = self._odometry_time = self._heartbeat_sent = self._requested = -np.inf
        self._arrived: dict[str, int] = {}  # number of messages since the last request, by name
        self._landed_state, self._landed_time = 0, -np.inf
        self._position_std = self._velocity_std = math.nan
        self._ground_height, self._range_time = math.nan, -np.inf
        self._attitude: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
        self._estimate: EstimatorState | None = None
        self._origin: tuple[Any, ...] | None = None
        self._resets = self._detected_resets = 0

    @property
    def peer(self) -> str | None:
        """Where commands go, see `aero_planner.onboard.transport.Transport`; None before the autopilot is heard."""
        return self._transport.peer

    def poll(self) -> None:
        """Read what has arrived, and send a heartbeat when one is due. Never blocks; never raises for bad data."""
        if not self._polling.acquire(blocking=False):
            return  # another thread is polling
        try:
            self._receive()
            now = self._time()
            if now - self._heartbeat_sent >= 1.0:
                self._heartbeat_sent = now
                kind, none = self._dialect.MAV_TYPE_ONBOARD_CONTROLLER, self._dialect.MAV_AUTOPILOT_INVALID
                active = self._dialect.MAV_STATE_ACTIVE
                self.send_message(self._dialect.MAVLink_heartbeat_message(kind, none, 0, 0, active, 3))
        finally:
            self._polling.release()

    def close(self) -> None:
        """Release the connection."""
        self._transport.close()

    @property
    def strangers(self) -> int:
        """Number of datagrams that were dropped unread: of strangers, or for lack of room."""
        return self._transport.ignored

    def _receive(self) -> None:
        """Read what has arrived, within the limits of one poll."""
        deadline = time.thread_time() + _POLL_TIME
        for _ in range(_DATAGRAMS_PER_POLL):
            data = self._transport.receive()
            if data is None:
                return
            messages = self.parser.parse(data)
            if self._signatures is not None:
                self.min_signing_time = self._signatures.newest
            for message in messages:
                self._process(message)
            if time.thread_time() > deadline:
                return

    def _process(self, message: Any) -> None:
        name, sender = message.get_type(), self._transport.sender
        if name == _GOAL:
            self._process_goal(message, sender)
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._system, 1):
            return
        if sender is not None:
            self._ignore(f"{name} of the autopilot from {sender}", "only the first autopilot that was heard is obeyed")
            return
        self._transport.accept_sender()
        self.received[name] = self.received.get(name, 0) + 1
        if name == "HEARTBEAT":
            self._process_heartbeat(message)
        elif name == "EXTENDED_SYS_STATE":
            self._process_landed_state(message)
        elif name == "PARAM_VALUE":
            self._process_parameter(message)
        elif name == "DISTANCE_SENSOR":
            self._process_distance(message)
        elif name == "ODOMETRY":
            self._process_odometry(message)
        elif name == "ATTITUDE_QUATERNION":
            self._process_attitude(message)
        elif name == "LOCAL_POSITION_NED":
            self._process_position(message)

    def _process_heartbeat(self, message: Any) -> None:
        self._heartbeat_time = now = self._time()
        self._armed = bool(message.base_mode & self._dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        self.is_px4 = message.autopilot == self._dialect.MAV_AUTOPILOT_PX4
        custom = message.base_mode & self._dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._offboard = bool(custom) and message.custom_mode >> 16 & 0xFF == _PX4_OFFBOARD
        if self.state is not None:
            self.state = self._make_sample(self.state.time, self.state.state)
        elapsed = now - self._requested
        if self._state_rate > 0.0 and elapsed >= _REQUEST_PERIOD:
            self._request_messages(min(elapsed, 1e6))
            self._requested = now
            self._arrived.clear()

    def _request_messages(self, elapsed: float) -> None:
        """Request each message that has arrived at less than 70 % of its rate in the last `elapsed` seconds."""
        d = self._dialect
        wanted = {
            "ODOMETRY": (d.MAVLINK_MSG_ID_ODOMETRY, self._state_rate),
            "EXTENDED_SYS_STATE": (d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, _LANDED_RATE),
            "DISTANCE_SENSOR": (d.MAVLINK_MSG_ID_DISTANCE_SENSOR, _RANGE_RATE),
        }
        for name, (number, rate) in wanted.items():
            if self._arrived.get(name, 0) < 0.7 * rate * elapsed:
                command = d.MAV_COMP_ID_AUTOPILOT1, d.MAV_CMD_SET_MESSAGE_INTERVAL, 0
                parameters = number, 1e6 / rate, *[0.0] * 5
                self.send_message(d.MAVLink_command_long_message(self._system, *command, *parameters))

    def request_parameter(self, name: str) -> None:
        """Ask the autopilot for a parameter, which then appears in `parameters`."""
        d = self._dialect
        target = self._system, d.MAV_COMP_ID_AUTOPILOT1
        self.send_message(d.MAVLink_param_request_read_message(*target, name.encode(), -1))

    def set_parameter(self, name: str, value: float) -> None:
        """Ask the autopilot to change a parameter that it has reported; its answer then appears in `parameters`."""
        d = self._dialect
        is_integer = name in self._integers
        kind = d.MAV_PARAM_TYPE_INT32 if is_integer else d.MAV_PARAM_TYPE_REAL32
        content = _FLOAT.unpack(_INTEGER.pack(int(value)))[0] if is_integer else value
        target = self._system, d.MAV_COMP_ID_AUTOPILOT1
        self.send_message(d.MAVLink_param_set_message(*target, name.encode(), content, kind))

    def _process_parameter(self, message: Any) -> None:
        name, value = str(message.param_id), float(message.param_value)
        if message.param_type == self._dialect.MAV_PARAM_TYPE_INT32:
            self._integers.add(name)
            value = float(_INTEGER.unpack(_FLOAT.pack(value))[0])  # PX4 sends the bits of the integer
        if name in self.parameters or len(self.parameters) < _PARAMETERS_MAX:
            self.parameters[name] = value

    def _process_landed_state(self, message: Any) -> None:
        self._landed_state, self._landed_time = message.landed_state, self._time()
        self._count_arrival("EXTENDED_SYS_STATE")
        if self.state is not None:
            self.state = self._make_sample(self.state.time, self.state.state)

    def _process_distance(self, message: Any) -> None:
        self._count_arrival("DISTANCE_SENSOR")
        now = self._time()
        if self.state is None or now - self.state.time > _RANGE_TIMEOUT:
            return
        is_downward = message.orientation == self._dialect.MAV_SENSOR_ROTATION_PITCH_270
        is_in_range = message.min_distance < message.current_distance < message.max_distance
        upright = float(rotate(self.state.state.quaternion, [0.0, 0.0, 1.0])[2])
        if not is_downward or not is_in_range or message.signal_quality == _INVALID_QUALITY:
            return
        if upright > math.cos(_RANGE_MAX_TILT):
            height = float(np.asarray(self.state.state.position)[2])
            self._ground_height, self._range_time = height - 1e-2 * message.current_distance * upright, now
            self.state = self._make_sample(self.state.time, self.state.state)

    def _count_arrival(self, name: str) -> None:
        self._arrived[name] = self._arrived.get(name, 0) + 1

    def _process_odometry(self, message: Any) -> None:
        d = self._dialect
        arrival = self._time()
        attitude = _normalized(message.q)
        velocity = np.array([message.vx, message.vy, message.vz])
        local = d.MAV_FRAME_LOCAL_NED, d.MAV_FRAME_LOCAL_FRD
        body = message.child_frame_id in (d.MAV_FRAME_BODY_FRD, d.MAV_FRAME_BODY_NED)
        if message.frame_id not in local or not (body or message.child_frame_id in local):
            return self._drop(f"ODOMETRY in frames {message.frame_id} and {message.child_frame_id}")
        if attitude is None or not np.isfinite(velocity).all():
            return self._drop(f"ODOMETRY that is not finite or beyond {_LIMIT:g}")
        if body:
            velocity = rotate(attitude, velocity)
        time = self._clocks["ODOMETRY"].to_host(1e-6 * message.time_usec, arrival)
        origin = "ODOMETRY", message.frame_id, message.reset_counter
        stds = _largest_std(message.pose_covariance), _largest_std(message.velocity_covariance)
        if self._set_state(origin, time, [message.x, message.y, message.z], velocity, attitude, stds):
            self._odometry_time = arrival
            self._count_arrival("ODOMETRY")

    def _process_attitude(self, message: Any) -> None:
        stamp, attitude = 1e-3 * message.time_boot_ms, _normalized([message.q1, message.q2, message.q3, message.q4])
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        if attitude is None or not np.isfinite(rates).all():
            self._drop("ATTITUDE_QUATERNION that is not finite")
        elif self._attitude is None or not 0.0 <= self._attitude[0] - stamp < _OVERTAKEN:
            self._attitude = stamp, attitude, rates

    def _process_position(self, message: Any) -> None:
        arrival, stamp = self._time(), 1e-3 * message.time_boot_ms
        if arrival - self._odometry_time < _ODOMETRY_TIMEOUT or self._attitude is None:
            return
        # Both stamps are from the same clock.
        attitude_stamp, attitude, rates = self._attitude
        if abs(stamp - attitude_stamp) > _PAIR_TIMEOUT:
            return
        time = self._clocks["LOCAL_POSITION_NED"].to_host(stamp, arrival)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        attitude = integrate_rates(attitude, rates, stamp - attitude_stamp)
        estimate = EstimatorState(stamp, position, velocity, attitude, rates)
        is_reset = self._estimate is not None and is_estimator_reset(self._estimate, estimate)
        resets = self._detected_resets + is_reset
        if self._set_state(("LOCAL_POSITION_NED", resets), time, position, velocity, attitude):
            self._estimate, self._detected_resets = estimate, resets

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
            self._drop(f"{origin[0]} with an inconsistent time stamp")
            return False
        # Written so that NaN fails.
        if not (np.abs(p).max() <= _LIMIT and np.abs(v).max() <= _LIMIT):
            self._drop(f"{origin[0]} that is not finite or beyond {_LIMIT:g}")
            return False
        if self.state is not None and time <= self.state.time:
            return False
        self._resets += self._origin not in (None, origin)
        self._origin = origin
        self._position_std, self._velocity_std = stds
        self.state = self._make_sample(time, VehicleState(p, v, q, time=time))
        return True

    def _make_sample(self, time: float, state: VehicleState) -> VehicleSample:
        in_air = None
        if self._time() - self._landed_time <= _LANDED_TIMEOUT and self._landed_state:
            in_air = self._landed_state == self._dialect.MAV_LANDED_STATE_IN_AIR
        return VehicleSample(
            time, state, self._armed, self._offboard, self._heartbeat_time, self._resets, in_air,
            self._position_std, self._velocity_std,
            self._ground_height if self._time() - self._range_time <= _RANGE_TIMEOUT else math.nan,
        )  # fmt: skip

    def _process_goal(self, message: Any, sender: str | None) -> None:
        is_for_us = message.target_system in (0, self._system) and message.target_component in (0, self._component)
        if not is_for_us:
            return
        system = message.get_srcSystem()
        if self._transport.peer is None:
            return  # the autopilot is not known yet, so neither is whether it forwards this
        if (system, sender) not in self._goal_senders:
            entry = f"{system}@{sender or 'autopilot'}"
            self._ignore(f"goal from {entry}", f"add {entry} to mavlink.goal_senders to obey it")
            return
        self.received[_GOAL] = self.received.get(_GOAL, 0) + 1
        position = world_from_ned([message.x, message.y, message.z])
        ignored = message.type_mask & 0b111  # POSITION_TARGET_TYPEMASK_X_IGNORE, Y, Z
        local = message.coordinate_frame == self._dialect.MAV_FRAME_LOCAL_NED
        if ignored or not local or not np.abs(position).max() <= _LIMIT:
            return self._drop("SET_POSITION_TARGET_LOCAL_NED in another frame, incomplete, or not finite")
        self.goal = position

    def _ignore(self, what: str, advice: str) -> None:
        if what not in self.ignored:
            if len(self.ignored) >= _IGNORED_MAX:
                return
            _log.warning("ignored: %s; %s", what, advice)
        self.ignored[what] = self.ignored.get(what, 0) + 1

    def _drop(self, reason: str) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + 1


def _largest_std(covariance: Sequence[float]) -> float:
    """Return the largest standard deviation of x, y and z in the upper triangle of a 6 x 6 matrix; NaN if unknown.

    An autopilot that does not know a variance sends NaN or 0.
    """
    known = [variance for variance in (covariance[0], covariance[6], covariance[11]) if variance > 0.0]
    return math.sqrt(max(known)) if known else math.nan


def _normalized(quaternion: ArrayLike) -> NDArray[np.float64] | None:
    """Return the unit quaternion [4]; None if the length is far from 1 or NaN."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(q))
    return q / length if 0.9 < length < 1.1 else None
