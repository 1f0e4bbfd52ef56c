"""The autopilot over MAVLink 2: state, heartbeat and goal in, body rates and thrust out.

The state comes from ODOMETRY or, while there is none that can be used, from LOCAL_POSITION_NED with
ATTITUDE_QUATERNION; a goal from SET_POSITION_TARGET_LOCAL_NED addressed to this component. The estimate has jumped when
ODOMETRY's reset counter changes, when LOCAL_POSITION_NED, which has none, moves as no flight does
(`aero_planner.onboard.estimator_reset`), and when the state comes from the other message.

Commands are SET_ATTITUDE_TARGET with body rates, forward-right-down, and normalised thrust. Besides them only a
heartbeat per second and requests for ODOMETRY are sent: nothing here can arm, or switch a mode.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.estimator_reset import EstimatorState, is_estimator_reset
from aero_planner.onboard.frames import attitude_from_ned, frd_from_flu, world_from_ned
from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.thrust import signal_from_force
from aero_planner.onboard.transport import Transport, open_transport
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.plan import VehicleState
from aero_planner.quaternions import integrate_rates, rotate

__all__ = ["MavlinkLink", "MavlinkSender", "load_dialect"]

_ODOMETRY_TIMEOUT = 1.0  # [s] without ODOMETRY after which the other two messages count
_PAIR_TIMEOUT = 0.1  # [s]; an older attitude does not go with a position
_OVERTAKEN = 1.0  # [s] by which an attitude may come late and be ignored; more means that the clock was set anew
_REQUEST_PERIOD = 2.0  # [s] between two requests for ODOMETRY
_PX4_OFFBOARD = 6  # main mode, bits 16 to 23 of a heartbeat's custom_mode
_MARKERS = (0xFD, 0xFE)  # first byte of a message, versions 2 and 1
_RETRIES = 32  # behind stray markers, per part of a stream
_LIMIT = 1e6  # [m], [m/s]; what is beyond has no precision left in float32
_BYTES_PER_POLL = 65_536  # a flood cannot hold the caller


def load_dialect() -> Any:
    """Return pymavlink's module of the common messages.

    Raises:
        ImportError: pymavlink is not installed; names the extra.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise ImportError(
            "MAVLink needs pymavlink, which is not installed; run: pip install 'aero-planner[mavlink]'."
        ) from error
    return common


class MavlinkSender:
    """Packs commands and other messages and sends them; implements `aero_planner.onboard.vehicle_link.CommandSink`.

    Args:
        port: to the autopilot; None sends nothing. It may be replaced at any time.
        system, component, mass, gravity, hover_thrust, curve, clock: as of `MavlinkLink`.

    Raises:
        ImportError: pymavlink is not installed.

    Attributes:
        sent: commands sent.
    """

    def __init__(
        self,
        port: Transport | None,
        *,
        system: int,
        component: int,
        mass: float,
        gravity: float,
        hover_thrust: float,
        curve: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.port = port
        self.sent = 0
        self._dialect = load_dialect()
        self._system = system
        self._vehicle = dict(mass=mass, gravity=gravity, hover_thrust=hover_thrust, curve=curve)
        self._time = clock
        self._packer = self._dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._sending = threading.Lock()

    def send(self, command: ArrayLike) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up; never blocks.

        Raises:
            ValueError: the command has another shape or is not finite; nothing was sent.
        """
        values = np.asarray(command, dtype=np.float64)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise ValueError(f"the command is {values.tolist()}; it must be a thrust and three rates, all finite.")
        thrust = signal_from_force(float(values[0]), **self._vehicle)
        rates = frd_from_flu(values[1:])
        message = self._dialect.MAVLink_set_attitude_target_message(
            int(1e3 * self._time()) & 0xFFFFFFFF,
            self._system,
            self._dialect.MAV_COMP_ID_AUTOPILOT1,
            self._dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE,
            [1.0, 0.0, 0.0, 0.0],
            *rates.tolist(),
            thrust,
        )
        self.sent += self.send_message(message)

    def send_message(self, message: Any) -> bool:
        """Send one of the dialect's messages; return whether there was a port and room."""
        with self._sending:
            data = message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256
            return self.port is not None and self.port.send(bytes(data))


class MavlinkLink:
    """A connection to an autopilot that speaks MAVLink; implements `aero_planner.onboard.vehicle_link.VehicleLink`.

    Args:
        url: see `aero_planner.onboard.transport.open_transport`.
        baud: of a serial device [bit/s].
        system: system id of the autopilot and of this computer.
        component: component id of this computer.
        mass: of the vehicle [kg].
        gravity: [m/s^2].
        hover_thrust, curve: see `aero_planner.onboard.thrust`.
        state_rate: ODOMETRY messages per second that the autopilot is asked for; 0 asks for nothing.
        clock: host time [s].

    Raises:
        ImportError: pymavlink is not installed.
        ValueError, OSError: see `open_transport`.

    Attributes:
        state, goal: see `VehicleLink`.
        received: messages understood, by name.
        bad: parts of what came that were no message: wrong checksum, garbage.
        dropped: states and goals that could not be used, by message and reason.
    """

    def __init__(
        self,
        url: str = "udpin:127.0.0.1:14540",
        *,
        baud: int = 921_600,
        system: int = 1,
        component: int = 191,
        mass: float = 1.0,
        gravity: float = 9.81,
        hover_thrust: float = 0.5,
        curve: float = 0.0,
        state_rate: float = 100.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._dialect = load_dialect()
        self._port = open_transport(url, baud=baud)
        self._system, self._component = system, component
        self._sender = MavlinkSender(
            self._port,
            system=system,
            component=component,
            mass=mass,
            gravity=gravity,
            hover_thrust=hover_thrust,
            curve=curve,
            clock=clock,
        )
        self._state_rate = state_rate
        self._time = clock
        self._parser = self._new_protocol()
        self._polling = threading.Lock()
        self.state: VehicleSample | None = None
        self.goal: NDArray[np.float64] | None = None
        self.received: dict[str, int] = {}
        self.dropped: dict[str, int] = {}
        self.bad = 0
        self._clocks = {name: HostClock() for name in ("ODOMETRY", "LOCAL_POSITION_NED")}
        self._armed = self._offboard = False
        self._heartbeat_time = self._odometry_time = self._heartbeat_sent = self._requested = -np.inf
        self._odometry_count = 0
        self._attitude: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
        self._fix: EstimatorState | None = None
        self._origin: tuple[Any, ...] | None = None
        self._resets = self._jumps = 0

    @property
    def sent(self) -> int:
        """Commands sent."""
        return self._sender.sent

    @property
    def partner(self) -> str | None:
        """Where commands go, see `aero_planner.onboard.transport.Port`; None before the autopilot has been heard."""
        return self._port.partner

    def _new_protocol(self) -> Any:
        protocol = self._dialect.MAVLink(None, srcSystem=self._system, srcComponent=self._component)
        protocol.robust_parsing = True
        return protocol

    def poll(self) -> None:
        """Take in what has arrived, and keep the connection alive; never blocks, never raises for what came."""
        if not self._polling.acquire(blocking=False):
            return  # another thread is at it
        try:
            budget = _BYTES_PER_POLL
            while budget > 0 and (data := self._port.receive()) is not None:
                budget -= len(data)
                for message in self._parse(data):
                    self._take(message)
            now = self._time()
            if now - self._heartbeat_sent >= 1.0:
                self._heartbeat_sent = now
                kind, none = self._dialect.MAV_TYPE_ONBOARD_CONTROLLER, self._dialect.MAV_AUTOPILOT_INVALID
                active = self._dialect.MAV_STATE_ACTIVE
                self._sender.send_message(self._dialect.MAVLink_heartbeat_message(kind, none, 0, 0, active, 3))
        finally:
            self._polling.release()

    def send(self, command: ArrayLike) -> None:
        """Command the vehicle, see `MavlinkSender.send`."""
        self._sender.send(command)

    def close(self) -> None:
        """Release the connection."""
        self._port.close()

    def _parse(self, data: bytes) -> list[Any]:
        messages: list[Any] = []
        try:
            message = self._parser.parse_char(data)
            retries = 0 if self._port.datagrams else _RETRIES
            while message is not None:
                if message.get_type() != "BAD_DATA":
                    messages.append(message)
                else:
                    self.bad += 1
                    if retries and len(message.data) > 1 and message.data[0] in _MARKERS:
                        # A stray marker on a line claimed what follows: look again behind it.
                        retries -= 1
                        at = self._parser.buf_index
                        self._parser.buf[at:at] = message.data[1:]
                message = self._parser.parse_char(b"")
        except Exception:  # whatever pymavlink makes of bytes from the network, the node goes on
            self.bad += 1
            self._parser = self._new_protocol()
            return messages
        if self._parser.buf_index:  # pymavlink keeps what it has read until it is at the end of all
            del self._parser.buf[: self._parser.buf_index]
            self._parser.buf_index = 0
        if self._port.datagrams and self._parser.buf_len():  # the rest of a broken one must not swallow the next
            self._parser = self._new_protocol()
            self.bad += 1
        return messages

    def _take(self, message: Any) -> None:
        name = message.get_type()
        if name.startswith("UNKNOWN"):
            name = "UNKNOWN"
        self.received[name] = self.received.get(name, 0) + 1
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            self._take_goal(message)
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._system, 1):
            return
        self._port.accept()
        if name == "HEARTBEAT":
            self._take_heartbeat(message)
        elif name == "ODOMETRY":
            self._take_odometry(message)
        elif name == "ATTITUDE_QUATERNION":
            self._take_attitude(message)
        elif name == "LOCAL_POSITION_NED":
            self._take_position(message)

    def _take_heartbeat(self, message: Any) -> None:
        self._heartbeat_time = now = self._time()
        self._armed = bool(message.base_mode & self._dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        custom = message.base_mode & self._dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._offboard = bool(custom) and message.custom_mode >> 16 & 0xFF == _PX4_OFFBOARD
        if self.state is not None:
            self.state = self._sample(self.state.time, self.state.state)
        elapsed = now - self._requested
        if self._state_rate > 0.0 and elapsed >= _REQUEST_PERIOD:
            if self._odometry_count < 0.7 * self._state_rate * min(elapsed, 1e6):
                self._request_odometry()
            self._requested, self._odometry_count = now, 0

    def _request_odometry(self) -> None:
        d = self._dialect
        command = d.MAV_COMP_ID_AUTOPILOT1, d.MAV_CMD_SET_MESSAGE_INTERVAL, 0
        parameters = d.MAVLINK_MSG_ID_ODOMETRY, 1e6 / self._state_rate, *[0.0] * 5
        self._sender.send_message(d.MAVLink_command_long_message(self._system, *command, *parameters))

    def _take_odometry(self, message: Any) -> None:
        d = self._dialect
        arrival = self._time()
        attitude = _unit(message.q)
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
        if self._set_state(origin, time, [message.x, message.y, message.z], velocity, attitude):
            self._odometry_time = arrival
            self._odometry_count += 1

    def _take_attitude(self, message: Any) -> None:
        stamp, attitude = 1e-3 * message.time_boot_ms, _unit([message.q1, message.q2, message.q3, message.q4])
        rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        if attitude is None or not np.isfinite(rates).all():
            self._drop("ATTITUDE_QUATERNION that is not finite")
        elif self._attitude is None or not 0.0 <= self._attitude[0] - stamp < _OVERTAKEN:
            self._attitude = stamp, attitude, rates

    def _take_position(self, message: Any) -> None:
        arrival, stamp = self._time(), 1e-3 * message.time_boot_ms
        if arrival - self._odometry_time < _ODOMETRY_TIMEOUT or self._attitude is None:
            return
        # Both stamps are from one clock.
        measured, attitude, rates = self._attitude
        if abs(stamp - measured) > _PAIR_TIMEOUT:
            return
        time = self._clocks["LOCAL_POSITION_NED"].to_host(stamp, arrival)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        fix = EstimatorState(stamp, position, velocity, integrate_rates(attitude, rates, stamp - measured), rates)
        jumps = self._jumps + (self._fix is not None and is_estimator_reset(self._fix, fix))
        if self._set_state(("LOCAL_POSITION_NED", jumps), time, position, velocity, fix.attitude):
            self._fix, self._jumps = fix, jumps

    def _set_state(
        self, origin: tuple[Any, ...], time: float | None, position: ArrayLike, velocity: ArrayLike, attitude: ArrayLike
    ) -> bool:
        """Take over a state north-east-down, unless it is unusable or not newer than the present one; return whether.

        States of one origin, which begins with the message's name, go together; with another one the estimate jumps.
        """
        p, v, q = world_from_ned(position), world_from_ned(velocity), attitude_from_ned(attitude)
        if time is None:
            self._drop(f"{origin[0]} whose time does not fit")
            return False
        # Written so that NaN fails.
        if not (np.abs(p).max() <= _LIMIT and np.abs(v).max() <= _LIMIT):
            self._drop(f"{origin[0]} that is not finite or beyond {_LIMIT:g}")
            return False
        if self.state is not None and time <= self.state.time:
            return False
        self._resets += self._origin not in (None, origin)
        self._origin = origin
        self.state = self._sample(time, VehicleState(p, v, q, time=time))
        return True

    def _sample(self, time: float, state: VehicleState) -> VehicleSample:
        return VehicleSample(time, state, self._armed, self._offboard, self._heartbeat_time, self._resets)

    def _take_goal(self, message: Any) -> None:
        ours = message.target_system in (0, self._system) and message.target_component in (0, self._component)
        if not ours:
            return
        position = world_from_ned([message.x, message.y, message.z])
        ignored = message.type_mask & 0b111  # POSITION_TARGET_TYPEMASK_X_IGNORE, Y, Z
        local = message.coordinate_frame == self._dialect.MAV_FRAME_LOCAL_NED
        if ignored or not local or not np.abs(position).max() <= _LIMIT:
            return self._drop("SET_POSITION_TARGET_LOCAL_NED in another frame, in part, or not finite")
        self.goal = position

    def _drop(self, what: str) -> None:
        self.dropped[what] = self.dropped.get(what, 0) + 1


def _unit(quaternion: ArrayLike) -> NDArray[np.float64] | None:
    """Return the quaternion [4] with length 1; None when it is nowhere near that, as NaN is."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(q))
    return q / length if 0.9 < length < 1.1 else None
