"""The autopilot over MAVLink 2: receives vehicle state, heartbeat and goal; sends thrust and body rates.

The first autopilot with the system id of the settings is the only one from then on: messages from elsewhere are
ignored, except for goals and missions from the senders that the settings name. A goal comes from
SET_POSITION_TARGET_LOCAL_NED addressed to this component, a mission as `aero_planner.onboard.mavlink_mission` tells,
the state as `aero_planner.onboard.mavlink_state` does.

Besides commands (`MavlinkSender`), only a heartbeat per second, TIMESYNC, answers to missions and their progress, and
requests for messages and parameters are sent, and in preflight changes of parameters: nothing here can arm the vehicle
or switch its mode.
"""

from __future__ import annotations

import logging
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.mission_progress import MissionProgress
from aero_planner.onboard.frames import world_from_ned
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.mavlink_mission import MissionReceiver
from aero_planner.onboard.mavlink_parser import MavlinkParser
from aero_planner.onboard.mavlink_sender import MavlinkSender, load_dialect
from aero_planner.onboard.mavlink_signing import SignatureChecker
from aero_planner.onboard.mavlink_state import COORDINATE_LIMIT, StateReceiver
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.signing_memory import SigningMemory
from aero_planner.onboard.thrust import ThrustModel
from aero_planner.onboard.transport import Address, open_transport

_log = logging.getLogger(__name__)

_REQUEST_PERIOD = 2.0  # [s] between two requests for messages
_LANDED_RATE = 5.0  # [Hz] of EXTENDED_SYS_STATE
_RANGE_RATE = 10.0  # [Hz] of DISTANCE_SENSOR
_FIX_RATE = 5.0  # [Hz] of GPS_RAW_INT
_STATUS_RATE = 5.0  # [Hz] of SYS_STATUS
_BATTERY_RATE = 1.0  # [Hz] of BATTERY_STATUS
_MODE_PERIOD = 0.1  # [s] between two requests for the heartbeat of an armed vehicle: PX4 sends only one per second
_DATAGRAMS_PER_POLL = 128  # twenty times as many as arrive in a control period
_POLL_TIME = 0.004  # [s] of processor time that a poll may take; what is left waits in the socket
_GOAL = "SET_POSITION_TARGET_LOCAL_NED"
_WANTED = (*StateReceiver.MESSAGES, *MissionReceiver.MESSAGES, "PARAM_VALUE", "HOME_POSITION", _GOAL)
_PARAMETERS_MAX = 5000
_FLOAT, _INTEGER = struct.Struct("<f"), struct.Struct("<i")
_IGNORED_MAX = 20  # kinds of ignored messages that are counted separately


class MavlinkLink(MavlinkSender):
    """A connection to an autopilot that speaks MAVLink; implements `aero_planner.onboard.interfaces.VehicleLink`.

    Args:
        url: See `aero_planner.onboard.transport.open_transport`.
        thrust: Thrust model of the vehicle.
        baud: Baud rate of a serial device [bit/s].
        system: System id of the autopilot and of this computer.
        component: Component id of this computer.
        state_rate: ODOMETRY messages per second that are requested from the autopilot; 0 requests no messages.
        round_trip_time: See `StateReceiver`.
        goal_senders: System id and address of each sender of goals; None for the address stands for the autopilot's
            connection.
        key: Key of the signatures, 32 bytes; messages without a valid one are ignored. None accepts all.
        memory: What was accepted with this key before; None knows of nothing.
        clock: Host time [s].
        place: Returns a sample of the autopilot with another position, velocity and attitude, such as
            `RosOdometry.place`; None leaves its own.

    Raises:
        ImportError: pymavlink is not installed.
        ValueError, OSError: See `open_transport`.

    Attributes:
        goal: See `VehicleLink`.
        parser: Parser of what is received, with its counters.
        received: Number of messages used, by name.
        dropped: Number of states and goals that could not be used, by message and reason.
        parameters: Values of the autopilot's parameters that have arrived, by name; integers, too, in PX4's encoding.
        ignored: Number of messages that were ignored because of their sender, by kind and sender.
        is_drained: True if the newest poll has read all that had arrived.
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
        round_trip_time: float = 1.0,
        goal_senders: Collection[tuple[int, str | None]] | None = None,
        key: bytes | None = None,
        memory: SigningMemory | None = None,
        clock: Callable[[], float] = time.monotonic,
        place: Callable[[VehicleSample | None], VehicleSample | None] | None = None,
    ) -> None:
        load_dialect()  # raises before the transport is opened
        senders = ((system, None),) if goal_senders is None else goal_senders
        self._goal_senders = frozenset((number, host and socket.gethostbyname(host)) for number, host in senders)
        hosts = {host for _, host in self._goal_senders if host is not None}
        self._transport = open_transport(url, baud=baud, allowed=hosts)
        super().__init__(self._transport, system=system, component=component, thrust=thrust, clock=clock, key=key)
        self._signatures = None if key is None else SignatureChecker(key, memory)
        if self._signatures is not None:
            self.min_signing_time = self._signatures.newest
        self.parser = MavlinkParser(
            self._dialect,
            datagrams=self._transport.datagrams,
            wanted=_WANTED,
            systems={system, *(sender for sender, _ in self._goal_senders)},
            signatures=self._signatures,
        )
        self._missions = MissionReceiver(self._dialect, system, component, clock, self.send_message)
        self._state_rate = state_rate
        self._polling = threading.Lock()
        self.is_drained = False
        self.goal: NDArray[np.float64] | None = None
        self.received: dict[str, int] = {}
        self.ignored: dict[str, int] = {}
        self.parameters: dict[str, float] = {}
        self._integers: set[str] = set()
        self._receiver, self._place = StateReceiver(clock, round_trip_time), place
        self.dropped = self._receiver.dropped  # goals as well as states
        self._heartbeat_sent = self._requested = self._mode_requested = -np.inf
        self._arrived: dict[str, int] = {}  # number of usable messages since the last request, by name

    @property
    def state(self) -> VehicleSample | None:
        """See `VehicleLink`."""
        sample = self._receiver.sample
        return sample if self._place is None else self._place(sample)

    @property
    def vehicle_kind(self) -> str | None:
        """What the vehicle says it is, such as "PX4 QUADROTOR"; None before its first heartbeat."""
        return self._receiver.kind

    @property
    def is_supported(self) -> bool:
        """False once the vehicle has said that it is anything but a PX4 that flies a multicopter."""
        return self._receiver.supported

    @property
    def peer(self) -> str | None:
        """Destination of commands, see `onboard.transport.Transport`; None before the autopilot is heard."""
        return self._transport.peer

    @property
    def offer(self) -> MissionOffer | None:
        """See `VehicleLink`."""
        return self._missions.offer

    def report_mission(self, progress: MissionProgress | None) -> None:
        """See `VehicleLink`."""
        self._missions.report(progress)

    def send_message(self, message: Any, address: Address | None = None) -> bool:
        """See `MavlinkSender`; a vehicle that is not supported gets no message at all."""
        return self.is_supported and super().send_message(message, address)

    def poll(self) -> None:
        """Read the messages that have arrived, and send a heartbeat when one is due.

        Never blocks; never raises for bad data.
        """
        if not self._polling.acquire(blocking=False):
            return  # another thread is polling
        try:
            self._receive()
            self._missions.step()
            self._request_mode()
            self._request_time()
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
        if self._signatures is not None:
            self._signatures.close()

    @property
    def dropped_datagrams(self) -> int:
        """Number of datagrams that were dropped unread: from unknown senders, or for lack of room."""
        return self._transport.dropped_datagrams

    def _receive(self) -> None:
        """Read the messages that have arrived, within the limits of one poll."""
        deadline = time.thread_time() + _POLL_TIME
        self.is_drained = False
        for _ in range(_DATAGRAMS_PER_POLL):
            data = self._transport.receive()
            if data is None:
                self.is_drained = True
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
        elif name in MissionReceiver.MESSAGES:
            if self._missions.is_addressed(message) and self._may_send(message, sender, "mission"):
                self._missions.process(message, self._transport.reply_address)
            return
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._system, 1):
            return
        if sender is not None:
            self._ignore(f"{name} of the autopilot from {sender}", "only the first autopilot that was heard is obeyed")
            return
        self._transport.accept_sender()
        self.received[name] = self.received.get(name, 0) + 1
        if name == "PARAM_VALUE":
            self._process_parameter(message)
        elif name == "HOME_POSITION":
            self._missions.set_home(message)
        elif name in StateReceiver.MESSAGES:
            self._arrived[name] = self._arrived.get(name, 0) + self._receiver.process(message)
        if name == "HEARTBEAT":
            self._request_missing_messages()
        if self._receiver.is_mode_unknown and name == "COMMAND_ACK":
            self._mode_requested = -np.inf

    def _request_mode(self) -> None:
        """Request the heartbeat of an armed vehicle, so that a pilot who takes over for a moment is noticed."""
        now, d = self._time(), self._dialect
        if self._state_rate > 0.0 and self._receiver.is_armed and now - self._mode_requested >= _MODE_PERIOD:
            self._mode_requested = now
            command = d.MAV_COMP_ID_AUTOPILOT1, d.MAV_CMD_REQUEST_MESSAGE, 0
            self.send_message(d.MAVLink_command_long_message(self._system, *command, *[0.0] * 7))

    def _request_time(self) -> None:
        if self._state_rate > 0.0 and self._receiver.kind is not None:
            requested = self._receiver.round_trips.request(self._time())
            if requested is not None:
                self.send_message(self._dialect.MAVLink_timesync_message(0, requested))

    def _request_missing_messages(self) -> None:
        now = self._time()
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
            "GPS_RAW_INT": (d.MAVLINK_MSG_ID_GPS_RAW_INT, _FIX_RATE),
            "SYS_STATUS": (d.MAVLINK_MSG_ID_SYS_STATUS, _STATUS_RATE),
            "BATTERY_STATUS": (d.MAVLINK_MSG_ID_BATTERY_STATUS, _BATTERY_RATE),
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

    def _process_goal(self, message: Any, sender: str | None) -> None:
        is_for_us = message.target_system in (0, self._system) and message.target_component in (0, self._component)
        if not is_for_us or not self._may_send(message, sender, "goal"):
            return
        self.received[_GOAL] = self.received.get(_GOAL, 0) + 1
        position = world_from_ned([message.x, message.y, message.z])
        ignored = message.type_mask & 0b111  # POSITION_TARGET_TYPEMASK_X_IGNORE, Y, Z
        local = message.coordinate_frame == self._dialect.MAV_FRAME_LOCAL_NED
        if ignored or not local or not np.abs(position).max() <= COORDINATE_LIMIT:
            return self._drop("SET_POSITION_TARGET_LOCAL_NED in another frame, incomplete, or not finite")
        self.goal = position

    def _may_send(self, message: Any, sender: str | None, what: str) -> bool:
        """Return True if goals and missions are taken from who has sent a message."""
        if self._transport.peer is None:
            return False  # the autopilot is not known yet, so neither is whether it forwards this
        system = message.get_srcSystem()
        if (system, sender) in self._goal_senders:
            return True
        entry = f"{system}@{sender or 'autopilot'}"
        self._ignore(f"{what} from {entry}", f"add {entry} to mavlink.goal_senders to obey it")
        return False

    def _ignore(self, what: str, advice: str) -> None:
        if what not in self.ignored:
            if len(self.ignored) >= _IGNORED_MAX:
                return
            _log.warning("ignored: %s; %s", what, advice)
        self.ignored[what] = self.ignored.get(what, 0) + 1

    def _drop(self, reason: str) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + 1
