"""A simulated autopilot: MAVLink over UDP, a vehicle at 250 Hz, and PX4's rules for offboard control."""

from __future__ import annotations

import contextlib
import enum
import math
import socket
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.frames import attitude_to_ned, flu_from_frd, frd_from_flu, ned_from_world
from aero_planner.onboard.mavlink import load_dialect
from aero_planner.onboard.thrust import force_from_signal, signal_from_force
from aero_planner.quaternions import conjugate, rotate
from aero_viz.flight.vehicle import Vehicle, VehicleModel
from aero_viz.rig.faults import Channel

__all__ = ["PERIOD", "Mode", "Setpoint", "SimulatedAutopilot"]

PERIOD = 0.004
"""One step [s]."""

_BOOTED = 12.5  # [s] by the autopilot's clock when the simulation starts
_STREAM_TIME = 1.0  # [s] that setpoints must have been arriving before OFFBOARD is accepted
_RATE_STATE = 50.0  # [Hz] unless another is asked for
_RATES_MAX = 250.0
_KERNEL_TIME = 35  # SO_TIMESTAMPNS of Linux
_ODOMETRY, _COVARIANCE = 331, [math.nan] * 21
_NOT_FOR_THE_NODE = ("SET_MODE", "COMMAND_INT", "MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE", "PARAM_SET")


class Mode(enum.Enum):
    """What flies the vehicle, with PX4's custom mode."""

    HOLD = 4 << 16 | 3 << 24
    """The autopilot: it stops and stays."""
    OFFBOARD = 6 << 16
    """The companion computer."""


@dataclass(frozen=True)
class Setpoint:
    """One SET_ATTITUDE_TARGET as it was understood."""

    time: float
    """Of arrival, as the kernel saw it, since the start of the simulation [s]."""
    thrust: float
    """[N]"""
    rates: tuple[float, float, float]
    """[rad/s], forward-left-up."""
    mode: Mode
    """At the time of arrival: only OFFBOARD obeys."""


class SimulatedAutopilot:
    """An autopilot and its vehicle, which hangs still at its start until it is armed and holds there then.

    Args:
        model: of the vehicle.
        start: first position [m], shape [3], world frame.
        heading: first yaw [rad].
        address: host and UDP port of the companion computer.
        hover_thrust: setpoint at which the vehicle hovers.
        curve: of the motors, see `aero_planner.onboard.thrust`.
        compensation: how much of it the autopilot takes out itself; PX4's THR_MDL_FAC.
        loss_time: time without setpoint that ends the stream, and with it OFFBOARD; PX4's COM_OF_LOSS_T [s].
        pair: send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY.
        seed: of gusts and of the wires.

    Attributes:
        vehicle: the true state.
        mode, armed: what the next heartbeat tells.
        frozen: True repeats the last state over and over.
        setpoints: all that were understood.
        refused: setpoints that were not: another frame, not finite, or for somebody else.
        trespasses: what the companion asked for and must not: arming, modes, sticks.
        up, down: the wires to and from the companion.
    """

    def __init__(
        self,
        model: VehicleModel,
        start: ArrayLike,
        heading: float,
        address: tuple[str, int],
        *,
        hover_thrust: float = 0.5,
        curve: float = 0.0,
        compensation: float = 0.0,
        loss_time: float = 0.5,
        pair: bool = False,
        seed: int = 0,
    ) -> None:
        self.vehicle = Vehicle(model, np.atleast_2d(start), [heading], period=PERIOD, device="cpu", seeds=[seed])
        self.mode, self.armed, self.frozen = Mode.HOLD, False, False
        self.setpoints: list[Setpoint] = []
        self.refused = 0
        self.trespasses: list[str] = []
        self._model = model
        self._compensation = compensation
        self._motors: dict[str, float] = dict(
            mass=model.mass, gravity=model.gravity, hover_thrust=self._motor_signal(hover_thrust), curve=curve
        )
        self._flying = wp.zeros(1, dtype=int, device="cpu")
        self._command = wp.zeros((1, 1), dtype=wp.vec4, device="cpu")
        views = (self.vehicle.position, self.vehicle.velocity, self.vehicle.quaternion, self._command)
        self._p, self._v, self._q, self._u = (view.numpy().reshape(-1) for view in views)
        self._place: NDArray[np.float64] | None = np.array(start, dtype=np.float64)  # where to hold
        self._stream_began = self._stream_last = -math.inf
        self._dialect = load_dialect()
        self._protocol = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._protocol.robust_parsing = True
        self._pair, self._loss_time = pair, loss_time
        self._state_period = 1.0 / _RATE_STATE
        self._next_state = self._next_heartbeat = 0.0
        self._frozen_message: list[Any] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):  # where it is unknown, setpoints are timed by the step that finds them
            self._socket.setsockopt(socket.SOL_SOCKET, _KERNEL_TIME, 1)
        self._socket.bind(("127.0.0.1", 0))
        self._address = address
        self.up = Channel(self._deliver, seed=seed + 1)
        self.down = Channel(self._receive, seed=seed + 2)
        self._now = self._arrival = 0.0
        self._arrived: deque[tuple[float, bytes]] = deque()  # when, and what
        self._began: float | None = None  # host time of the simulation's start, CLOCK_REALTIME [s]

    @property
    def position(self) -> NDArray[np.float64]:
        """True position [m], shape [3], world frame."""
        return self._p.astype(np.float64)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """True velocity [m/s], shape [3], world frame."""
        return self._v.astype(np.float64)

    @property
    def streaming(self) -> bool:
        """Whether setpoints have been arriving for long enough to accept OFFBOARD."""
        return self._now - self._stream_last <= self._loss_time and self._now - self._stream_began >= _STREAM_TIME

    def arm(self) -> None:
        """The pilot's switch."""
        self.armed = True

    def engage(self) -> bool:
        """The pilot's switch to OFFBOARD; return whether the autopilot accepts."""
        if not (self.armed and self.streaming):
            return False
        self.mode = Mode.OFFBOARD
        return True

    def hold(self) -> None:
        """The pilot's switch to HOLD, or the failsafe's."""
        self.mode, self._place = Mode.HOLD, None

    def start(self) -> None:
        """Say that now is the time 0 of the simulation."""
        self._began = time.time()

    def step(self, tick: int, now: float) -> None:
        """Fly one step, from `now` - PERIOD to `now` [s] since the start, and talk to the companion."""
        self._now = now
        self._listen()
        if self.mode is Mode.OFFBOARD and now - self._stream_last > self._loss_time:
            self.hold()
        if self.armed:
            if self.mode is Mode.HOLD:
                self._u[:] = self._holding()
            else:
                self._u[0], self._u[1:] = self.setpoints[-1].thrust, self.setpoints[-1].rates
            self.vehicle.fly(self._command, finished=self._flying, tick=tick)
        self._talk()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _holding(self) -> NDArray[np.float64]:
        """Brake, then stay: the position asks for an acceleration, that for an attitude, that for rates."""
        velocity, up = self.velocity, np.array([0.0, 0.0, 1.0])
        if self._place is None and np.linalg.norm(velocity) < 0.5:
            self._place = self.position
        wanted = -2.5 * velocity - (0.0 if self._place is None else 2.0 * (self.position - self._place))
        wanted *= min(1.0, 6.0 / max(float(np.linalg.norm(wanted)), 1e-9))
        force = self._model.mass * (wanted + self._model.gravity * up)
        q = self._q.astype(np.float64)
        axis = rotate(q, up)
        turn = np.cross(axis, force / np.linalg.norm(force))
        rates = 8.0 * rotate(conjugate(q), turn)
        return np.array([force @ axis, rates[0], rates[1], 0.0])

    def _listen(self) -> None:
        while True:
            try:
                data, notes, _, _ = self._socket.recvmsg(2048, 64)
            except OSError:
                break
            arrival = self._now
            for level, kind, content in notes:
                if self._began is not None and (level, kind) == (socket.SOL_SOCKET, _KERNEL_TIME):
                    seconds, nanoseconds = struct.unpack("@ll", content)
                    arrival = seconds - self._began + 1e-9 * nanoseconds
            self._arrived.append((arrival, data))
        # A simulation that is late must not obey a command before it was sent: the rest is for later steps.
        while self._arrived and self._arrived[0][0] <= self._now:
            self._arrival, data = self._arrived.popleft()
            self.down.put(data, self._now)
        self._arrival = self._now
        self.down.flush(self._now)

    def _receive(self, data: bytes) -> None:
        try:
            messages = self._protocol.parse_buffer(data) or []
        except Exception:  # pymavlink on corrupted bytes
            messages = []
        if self._protocol.buf_len():  # the rest of a corrupted datagram
            seq = self._protocol.seq
            self._protocol = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
            self._protocol.robust_parsing, self._protocol.seq = True, seq
        for message in messages:
            name = message.get_type()
            if name == "SET_ATTITUDE_TARGET":
                self._take_setpoint(message)
            elif name == "COMMAND_LONG":
                self._take_command(message)
            elif name in _NOT_FOR_THE_NODE:
                self.trespasses.append(name)

    def _take_setpoint(self, message: Any) -> None:
        mask = message.type_mask
        d = self._dialect
        wanted = mask & d.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE and not mask & (
            d.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
            | d.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
            | d.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
            | d.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
        )
        ours = message.target_system in (0, 1) and message.target_component in (0, 1)
        values = [message.thrust, message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate]
        if not (wanted and ours and np.isfinite(values).all()):
            self.refused += 1
            return
        force = force_from_signal(self._motor_signal(min(max(values[0], 0.0), 1.0)), **self._motors)
        if self._now - self._stream_last > self._loss_time:
            self._stream_began = self._now
        self._stream_last = self._now
        rates = flu_from_frd(values[1:]).tolist()
        self.setpoints.append(Setpoint(self._arrival, force, tuple(rates), self.mode))

    def _motor_signal(self, thrust: float) -> float:
        """Return what the motors get, in [0, 1], for a share of the full thrust."""
        return signal_from_force(thrust, mass=1.0, gravity=1.0, hover_thrust=1.0, curve=self._compensation)

    def _take_command(self, message: Any) -> None:
        d = self._dialect
        if message.command != d.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.trespasses.append(f"COMMAND_LONG {message.command}")
            return
        known = message.param1 == _ODOMETRY and not self._pair and message.param2 > 0.0
        if known:
            self._state_period = max(1e-6 * message.param2, 1.0 / _RATES_MAX)
        result = d.MAV_RESULT_ACCEPTED if known else d.MAV_RESULT_UNSUPPORTED
        self._send(d.MAVLink_command_ack_message(message.command, result))

    def _talk(self) -> None:
        d = self._dialect
        self.up.flush(self._now)
        if self._now >= self._next_heartbeat:
            self._next_heartbeat = self._now + 1.0
            base = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (d.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
            status = d.MAV_STATE_ACTIVE if self.armed else d.MAV_STATE_STANDBY
            kind = d.MAV_TYPE_QUADROTOR
            self._send(d.MAVLink_heartbeat_message(kind, d.MAV_AUTOPILOT_PX4, base, self.mode.value, status, 3))
        if self._now >= self._next_state:
            self._next_state = max(self._next_state + self._state_period, self._now)
            if not (self.frozen and self._frozen_message):
                self._frozen_message = self._state_messages()
            for message in self._frozen_message:
                self._send(message)

    def _state_messages(self) -> list[Any]:
        d = self._dialect
        stamp = _BOOTED + self._now
        p, v = ned_from_world(self._p), ned_from_world(self._v)
        q = attitude_to_ned(self._q)
        rates = frd_from_flu(self.vehicle.control.numpy()[0, 1:])  # type: ignore[index]
        if self._pair:
            boot = int(1e3 * stamp)
            return [
                d.MAVLink_attitude_quaternion_message(boot, *q.tolist(), *rates.tolist()),
                d.MAVLink_local_position_ned_message(boot, *p.tolist(), *v.tolist()),
            ]
        frames = d.MAV_FRAME_LOCAL_NED, d.MAV_FRAME_LOCAL_NED
        motion = [*p.tolist(), q.tolist(), *v.tolist(), *rates.tolist()]
        return [d.MAVLink_odometry_message(int(1e6 * stamp), *frames, *motion, _COVARIANCE, _COVARIANCE, 0, 0)]

    def _send(self, message: Any) -> None:
        data = bytes(message.pack(self._protocol))
        self._protocol.seq = (self._protocol.seq + 1) % 256
        self.up.put(data, self._now)

    def _deliver(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens there now, as on a wire
            self._socket.sendto(data, self._address)
