"""PX4 in its own simulation as the rig's autopilot: the true pose, the pilot, and faults on the connections.

PX4 simulates the vehicle, too. The rig takes its true pose from HIL_STATE_QUATERNION, plays the pilot over PX4's
connection to a ground station, and stands between PX4 and the onboard computer, whose datagrams it passes on.

In lockstep, PX4 is stopped (SIGSTOP) except while its simulated time must advance. The flight then depends little on
the load of the machine.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.thrust import ThrustModel
from aero_viz.errors import UserError
from aero_viz.rig.faults import Channel
from aero_viz.rig.offboard import Mode, Setpoint
from aero_viz.rig.px4_process import HOST, Px4Process
from aero_viz.rig.px4_truth import Place, PosedVehicle, TruthTracker
from aero_viz.rig.setpoint_decoder import PILOT_MESSAGES, decode_setpoint

_STREAMS = {
    "HIL_STATE_QUATERNION": 250.0, "SYSTEM_TIME": 250.0, "HEARTBEAT": 10.0, "GPS_GLOBAL_ORIGIN": 1.0,
    "EXTENDED_SYS_STATE": 5.0,
}  # fmt: skip
"""Messages and their rates that the rig requests [Hz]."""

_TRUTH_TIME = 30.0  # [s] of simulated time for PX4 to report its place and the origin of its estimator
_STREAM_TIME = 1.0  # [s] that setpoints must have been arriving before the pilot switches to OFFBOARD
_STREAM_GAP = 0.5  # [s] without a setpoint that ends a stream
_PILOT_PERIOD = 0.5  # [s] between two attempts of the pilot
_STICK_PERIOD = 0.1  # [s] between two messages with the positions of the pilot's sticks
_PAUSE_LIMIT = 20.0  # [s] for PX4 to simulate one step
_ODOMETRY, _ATTITUDE_QUATERNION, _LOCAL_POSITION = 331, 31, 32
_STATES = (_ODOMETRY, _ATTITUDE_QUATERNION, _LOCAL_POSITION)
_WANTED = frozenset((0, 2, 49, 77, 115, 245, 253))  # the messages that `_handlers` names
_AUTO, _OFFBOARD, _TAKEOFF, _LOITER = 4, 6, 2, 3  # PX4's main modes and submodes
_MODES = {1: "MANUAL", 2: "ALTITUDE", 3: "POSITION", 5: "ACRO", _OFFBOARD: "OFFBOARD", 7: "STABILIZED"}
_AUTO_MODES = {1: "READY", _TAKEOFF: "TAKEOFF", _LOITER: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND", 9: "DESCEND"}
_SATELLITES = 10  # PX4's default of SIM_GPS_USED
_LOW_BATTERY = {"SIM_BAT_MIN_PCT": 20.0, "SIM_BAT_DRAIN": 1.0, "BAT_LOW_THR": 0.5}  # [%], [s], charge
_FORCE_DISARM = 21196.0


class Px4Autopilot:
    """Has the attributes of `aero_viz.rig.autopilot.SimulatedAutopilot` that a flight needs.

    Args:
        px4: a running PX4 that stands on the ground.
        address: host and UDP port of the companion computer.
        origin: where the vehicle stands [m], shape [3], world frame of the rig.
        heading: direction of PX4's north there [rad].
        thrust: thrust model of the vehicle.
        lockstep: stop PX4 while nothing asks for a step.
        seed: seed of faults on the connections.

    Raises:
        UserError: PX4 does not report a position.
    """

    def __init__(
        self,
        px4: Px4Process,
        address: tuple[str, int],
        *,
        origin: NDArray[np.float64],
        heading: float,
        thrust: ThrustModel,
        lockstep: bool = False,
        seed: int = 0,
    ) -> None:
        self.vehicle = PosedVehicle()
        self.mode, self.mode_name, self.armed, self.frozen = Mode.HOLD, "HOLD", False, False
        self.setpoints: list[Setpoint] = []
        self.refused = 0
        self.violations: list[str] = []
        self.messages: list[str] = []
        self._px4, self._address, self._thrust, self._lockstep = px4, address, thrust, lockstep
        self._dialect = load_dialect()
        self._station_protocol = self._dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self._from_px4, self._from_node = (self._dialect.MAVLink(None) for _ in range(2))
        self._from_px4.robust_parsing = self._from_node.robust_parsing = True
        self._station, self._side_of_px4, self._side_of_node = (_open(port) for port in (0, px4.companion_remote, 0))
        self.to_companion = Channel(self._deliver_to_node, seed=seed + 1)
        self.from_companion = Channel(self._deliver_to_px4, seed=seed + 2)
        self._now = self._start_time = 0.0
        self._tracker = TruthTracker(origin, heading)
        self._truth = self._tracker.newest
        self._estimator_origin: Place | None = None
        self._frozen_message: bytes | None = None
        self._main_mode = self._sub_mode = 0
        self._is_armed = self._in_air = False
        self._has_transmitter = True
        self._companion_heard_at = math.inf
        self._stream_start = self._last_setpoint_time = -math.inf
        self._next_attempt = self._next_heartbeat = self._next_sticks = -math.inf
        self._handlers = {
            "HEARTBEAT": self._handle_heartbeat,
            "SYSTEM_TIME": self._tracker.add_time,
            "HIL_STATE_QUATERNION": self._tracker.add_state,
            "GPS_GLOBAL_ORIGIN": self._handle_origin,
            "EXTENDED_SYS_STATE": self._handle_landed_state,
            "STATUSTEXT": self._handle_text,
        }
        try:
            self._wait_for_truth()
        except BaseException:
            self._close_sockets()
            raise

    # --- what a flight needs ---

    @property
    def position(self) -> NDArray[np.float64]:
        """True position [m], shape [3], world frame."""
        return self._truth.position

    @property
    def velocity(self) -> NDArray[np.float64]:
        """True velocity [m/s], shape [3], world frame."""
        return self._truth.velocity

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """True attitude, body to world, w x y z, shape [4]."""
        return self._truth.quaternion

    @property
    def ready_to_arm(self) -> bool:
        """True once the companion computer runs and PX4 knows where it is."""
        return self._now - self._companion_heard_at >= _STREAM_TIME and self._estimator_origin is not None

    def local(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a position [m], shape [3], world frame, in PX4's local frame, north-west-up.

        The origin of this frame is the place where PX4 initialised its estimator, which is slightly off.
        """
        return self._tracker.local(position, self._estimator_origin)

    def arm(self) -> None:
        """Begin to arm the vehicle and to take off, as the pilot does."""
        self.armed = True

    def engage(self) -> bool:
        """Switch to OFFBOARD once the vehicle hovers and setpoints arrive; return True when PX4 has done so."""
        if self.mode is Mode.OFFBOARD:
            return True
        is_streaming = self._now - self._last_setpoint_time <= _STREAM_GAP
        is_long_enough = self._now - self._stream_start >= _STREAM_TIME
        hovers = self._in_air and (self._main_mode, self._sub_mode) == (_AUTO, _LOITER)
        if hovers and is_streaming and is_long_enough and self._may_try():
            self._set_mode(_OFFBOARD)
        return False

    def lose_transmitter(self, lost: bool = True) -> None:
        """Send no sticks any more, or send them again."""
        self._has_transmitter = not lost

    def hold(self) -> None:
        """Switch to HOLD, as the pilot does."""
        self._set_mode(_AUTO, _LOITER)

    def lose_position(self, lost: bool = True) -> None:
        """Switch GNSS off, or on again."""
        self._set_parameter("SIM_GPS_USED", 0 if lost else _SATELLITES)

    def drain_battery(self) -> None:
        """Empty the simulated battery: within a few seconds, PX4 warns that it is low, but not yet critical."""
        for name, value in _LOW_BATTERY.items():
            self._set_parameter(name, value)

    def start(self) -> None:
        """Make the present the time 0 of the simulation."""
        self._start_time = self._tracker.time
        if self._lockstep:
            self._px4.pause()

    def step(self, tick: int, now: float) -> None:
        """Exchange messages, and in lockstep let PX4 fly until `now`, since the start of the simulation [s]."""
        del tick
        self._now = now
        self._receive_from_node()
        self._act_as_pilot()
        if self._lockstep:
            self._fly_until(self._start_time + now)
        else:
            self._receive_from_px4()
            self._px4.check()
        self.to_companion.flush(now)
        self.from_companion.flush(now)
        self._truth = self._tracker.at(self._start_time + now) if self._lockstep else self._tracker.newest
        self.vehicle.move(self._truth)

    def close(self) -> None:
        """Switch the motors off, which ends PX4's log, and close the sockets."""
        self._px4.resume()
        with contextlib.suppress(UserError):
            self._command(self._dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, _FORCE_DISARM)
            self._px4.check()
            time.sleep(1.0)
        self._close_sockets()

    def _close_sockets(self) -> None:
        for connection in (self._station, self._side_of_px4, self._side_of_node):
            connection.close()

    # --- PX4's messages ---

    def _wait_for_truth(self) -> None:
        clock = self._px4.clock
        end, next_request = clock() + _TRUTH_TIME, -math.inf
        while self._tracker.home is None or self._estimator_origin is None:
            if clock() > next_request:
                next_request = clock() + 1.0
                self._send_heartbeat()
                for name, rate in _STREAMS.items():
                    number = getattr(self._dialect, f"MAVLINK_MSG_ID_{name}")
                    self._command(self._dialect.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate)
                # PX4 sends the origin once, when its estimator starts, which has mostly been before this.
                origin = self._dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
                self._command(self._dialect.MAV_CMD_REQUEST_MESSAGE, origin)
            self._px4.check()
            self._receive_from_px4(timeout=0.1)
            if clock() > end:
                missing = "a position" if self._tracker.home is None else "the origin of its estimator"
                raise self._px4.failure(
                    f"PX4 does not report {missing} within {_TRUTH_TIME:g} s; is this PX4's own simulation (SIH)?"
                )

    def _fly_until(self, end: float) -> None:
        """Let PX4 run until its time is `end` [s]."""
        if self._tracker.time >= end:
            return
        limit = time.monotonic() + _PAUSE_LIMIT
        self._px4.resume()
        while self._tracker.time < end:
            self._receive_from_px4(timeout=0.01)
            self._px4.check()
            if time.monotonic() > limit:
                raise self._px4.failure(f"PX4's simulated time has not advanced for {_PAUSE_LIMIT:g} s")
        self._px4.pause()

    def _receive_from_px4(self, timeout: float = 0.0) -> None:
        select.select([self._station, self._side_of_px4], [], [], timeout)
        for data in _datagrams(self._station):
            if _message_id(data) in _WANTED:
                for message in _parse(self._from_px4, data):
                    if message.get_srcSystem() == self._px4.system and message.get_type() in self._handlers:
                        self._handlers[message.get_type()](message)
        for data in _datagrams(self._side_of_px4):
            self._pass_to_node(data)

    def _handle_heartbeat(self, message: Any) -> None:
        if message.autopilot != self._dialect.MAV_AUTOPILOT_PX4:
            return
        self._main_mode, self._sub_mode = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
        self._is_armed = bool(message.base_mode & self._dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        is_offboard = self._is_armed and self._main_mode == _OFFBOARD
        self.mode = Mode.OFFBOARD if is_offboard else Mode.HOLD
        names, number = (_AUTO_MODES, self._sub_mode) if self._main_mode == _AUTO else (_MODES, self._main_mode)
        self.mode_name = names.get(number, f"mode {self._main_mode}.{self._sub_mode}")

    def _handle_origin(self, message: Any) -> None:
        self._estimator_origin = 1e-7 * message.latitude, 1e-7 * message.longitude, 1e-3 * message.altitude

    def _handle_landed_state(self, message: Any) -> None:
        self._in_air = message.landed_state == self._dialect.MAV_LANDED_STATE_IN_AIR

    def _handle_text(self, message: Any) -> None:
        self.messages.append(f"{self._now:7.2f} s  {message.text}")

    # --- between PX4 and the node ---

    def _pass_to_node(self, data: bytes) -> None:
        number = _message_id(data)
        if not self.frozen and number == _ODOMETRY:
            self._frozen_message = data
        if self.frozen and number in _STATES:
            if number != _ODOMETRY or self._frozen_message is None:
                return
            data = self._frozen_message
        self.to_companion.put(data, self._now)

    def _receive_from_node(self) -> None:
        for data in _datagrams(self._side_of_node):
            self.from_companion.put(data, self._now)

    def _deliver_to_node(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens now; a real datagram would be lost, too
            self._side_of_node.sendto(data, self._address)

    def _deliver_to_px4(self, data: bytes) -> None:
        for message in _parse(self._from_node, data):
            self._observe(message)
        with contextlib.suppress(OSError):
            self._side_of_px4.sendto(data, (HOST, self._px4.companion_port))

    def _observe(self, message: Any) -> None:
        """Record the messages that the node sends to PX4."""
        d, name = self._dialect, message.get_type()
        self._companion_heard_at = min(self._companion_heard_at, self._now)
        if name == "SET_ATTITUDE_TARGET":
            setpoint = decode_setpoint(
                message, d, time=self._now, mode=self.mode, force=self._thrust.force, system=self._px4.system
            )
            if setpoint is None:
                self.refused += 1
                return
            if self._now - self._last_setpoint_time > _STREAM_GAP:
                self._stream_start = self._now
            self._last_setpoint_time = self._now
            self.setpoints.append(setpoint)
        elif name == "COMMAND_LONG" and message.command not in (
            d.MAV_CMD_SET_MESSAGE_INTERVAL,
            d.MAV_CMD_REQUEST_MESSAGE,
        ):
            self.violations.append(f"COMMAND_LONG {message.command}")
        elif name in PILOT_MESSAGES:
            self.violations.append(name)

    # --- the pilot ---

    def _act_as_pilot(self) -> None:
        if self._now >= self._next_heartbeat:
            self._next_heartbeat = self._now + 1.0
            self._send_heartbeat()
        if self._has_transmitter and self._now >= self._next_sticks:
            self._next_sticks = self._now + _STICK_PERIOD
            self._send_sticks()
        if self.armed and not self._in_air and not self._is_armed and self._may_try():
            self._set_mode(_AUTO, _TAKEOFF)
            self._command(self._dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def _may_try(self) -> bool:
        if self._now < self._next_attempt:
            return False
        self._next_attempt = self._now + _PILOT_PERIOD
        return True

    def _send_heartbeat(self) -> None:
        d = self._dialect
        self._send(d.MAVLink_heartbeat_message(d.MAV_TYPE_GCS, d.MAV_AUTOPILOT_INVALID, 0, 0, d.MAV_STATE_ACTIVE, 3))

    def _send_sticks(self) -> None:
        """Send centred sticks: without any, PX4's altitude mode lands."""
        half = 500  # of the thrust axis, from 0 to 1000: neither climb nor sink
        self._send(self._dialect.MAVLink_manual_control_message(self._px4.system, 0, 0, half, 0, 0))

    def _set_mode(self, main: int, sub: int = 0) -> None:
        custom = self._dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._command(self._dialect.MAV_CMD_DO_SET_MODE, custom, main, sub)

    def _set_parameter(self, name: str, value: float) -> None:
        """Set a parameter, which is an integer if the value is an int."""
        kind, content = self._dialect.MAV_PARAM_TYPE_REAL32, value
        if isinstance(value, int):
            kind, content = self._dialect.MAV_PARAM_TYPE_INT32, struct.unpack("<f", struct.pack("<i", value))[0]
        self._send(self._dialect.MAVLink_param_set_message(self._px4.system, 1, name.encode(), content, kind))

    def _command(self, command: int, *parameters: float) -> None:
        values = [*parameters, *[0.0] * (7 - len(parameters))]
        self._send(self._dialect.MAVLink_command_long_message(self._px4.system, 1, command, 0, *values))

    def _send(self, message: Any) -> None:
        data = bytes(message.pack(self._station_protocol))
        self._station_protocol.seq = (self._station_protocol.seq + 1) % 256
        with contextlib.suppress(OSError):
            self._station.sendto(data, (HOST, self._px4.station_port))


def _open(port: int) -> socket.socket:
    """Return a UDP socket of this host."""
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    result.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
    result.setblocking(False)
    result.bind((HOST, port))
    return result


def _datagrams(connection: socket.socket) -> list[bytes]:
    """Return all datagrams that have arrived."""
    result: list[bytes] = []
    with contextlib.suppress(OSError):
        while True:
            result.append(connection.recv(2048))
    return result


def _message_id(data: bytes) -> int:
    """Return the id of the first message in a datagram; -1 if it is none."""
    if len(data) >= 10 and data[0] == 0xFD:  # MAVLink 2
        return int.from_bytes(data[7:10], "little")
    return data[5] if len(data) >= 6 and data[0] == 0xFE else -1  # MAVLink 1


def _parse(protocol: Any, data: bytes) -> list[Any]:
    try:
        return protocol.parse_buffer(data) or []
    except Exception:  # raised by pymavlink for corrupted bytes
        return []
