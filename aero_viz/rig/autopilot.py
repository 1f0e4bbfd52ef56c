"""A simulated PX4 autopilot: MAVLink over UDP, a vehicle at 250 Hz, and PX4's rules for offboard control.

`aero_viz.rig.offboard` models how PX4 obeys setpoints, and `aero_viz.rig.hold` how it holds a position. The lags are
those of the vehicle's model.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections import deque
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.frames import attitude_to_ned, frd_from_flu, ned_from_world
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.thrust import ThrustModel
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.estimate_error import covariance, estimate_error
from aero_viz.rig.faults import Channel
from aero_viz.rig.hold import HoldControl
from aero_viz.rig.offboard import Mode, OffboardControl, Setpoint
from aero_viz.rig.periodic_message import PeriodicMessage
from aero_viz.rig.setpoint_decoder import PILOT_MESSAGES, decode_setpoint

PERIOD = 0.004
"""Duration of a simulation step [s]."""

_BOOT_TIME = 12.5  # [s] on the autopilot's clock when the simulation starts
_STREAM_TIME = 1.0  # [s] that setpoints must have been arriving before OFFBOARD is accepted
_DEFAULT_STATE_RATE = 50.0  # [Hz]
_MAX_STATE_RATE = 250.0  # [Hz]
_SO_TIMESTAMPNS = 35  # socket option of Linux: the kernel notes when a datagram arrived
_ODOMETRY, _ATTITUDE_QUATERNION, _EXTENDED_SYS_STATE, _GPS_RAW_INT = 331, 31, 245, 24  # message ids
_SYS_STATUS, _BATTERY_STATUS = 1, 147
_EXCEPT_OFFBOARD = 4  # bit of COM_RCL_EXCEPT
_FIX_RATE = 8.0  # [Hz]
_START_RADIUS = 0.2  # [m] from the start at which the take-off ends
_ARMING_TIME = 1.5  # [s] after which a companion has received a heartbeat of a disarmed vehicle


class SimulatedAutopilot:
    """An autopilot with its vehicle, which is fixed until it is armed, and then takes off to its start and holds it.

    Args:
        model: model of the vehicle.
        start: start position [m], shape [3], world frame.
        heading: yaw at the start [rad].
        address: host and UDP port of the companion computer.
        hover_thrust: thrust setpoint at which the vehicle hovers, in [0, 1].
        curve: thrust curve of the motors, see `aero_planner.onboard.thrust`.
        compensation: part of the curve that the autopilot compensates, PX4's THR_MDL_FAC.
        loss_time: time without setpoints after which the stream, and with it OFFBOARD, ends, PX4's COM_OF_LOSS_T [s].
        pair: send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY.
        ground: height on which the vehicle stands until it is armed [m]; None fixes it in the air, at its start.
        takeoff_time: shortest time from arming until the autopilot reports that the vehicle is in the air [s].
        height_offset: error of the reported height [m].
        lockstep: a command arrives in the step that reads it, instead of at the clock time at which it was sent.
        seed: seed of gusts and of faults on the connections.

    Attributes:
        vehicle: the true state of the vehicle.
        mode, armed: reported by the next heartbeat.
        frozen: True makes the autopilot repeat its last state.
        velocity_error: error of the reported velocity along y, to the west, with which the position drifts [m/s].
        parameters: PX4's parameters by name; an int where PX4's is an integer.
        setpoints: all setpoints that were understood.
        refused: number of setpoints with another frame, with values that are not finite, or for another component.
        violations: requests that only the pilot may make: arming, mode changes, stick inputs.
        to_companion, from_companion: the connections to and from the companion computer.
        port: UDP port of the autopilot.
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
        ground: float | None = None,
        takeoff_time: float = 0.5,
        height_offset: float = 0.0,
        lockstep: bool = False,
        seed: int = 0,
    ) -> None:
        place = np.array(start, dtype=np.float64)
        if ground is not None:
            place[2] = ground
        self.vehicle = Vehicle(model, place[None], [heading], period=PERIOD, device="cpu", seeds=[seed])
        self.mode, self.armed, self.frozen = Mode.HOLD, False, False
        self._is_battery_low, self._has_transmitter = False, True
        self.velocity_error = self._drift = 0.0  # [m/s], [m]
        self.parameters: dict[str, float | int] = {
            "COM_OF_LOSS_T": loss_time,
            "COM_OBL_RC_ACT": 5,
            "COM_RC_OVERRIDE": 3,
            "COM_RCL_EXCEPT": 4,
            "NAV_RCL_ACT": 1,
            "NAV_DLL_ACT": 0,
            "COM_LOW_BAT_ACT": 0,
            "COM_FLTT_LOW_ACT": 0,
            "COM_FLT_TIME_MAX": -1,
            "GF_ACTION": 2,
            "COM_WIND_MAX_ACT": 0,
            "COM_IMB_PROP_ACT": 0,
            "COM_ACT_FAIL_ACT": 0,
            "BAT_CRIT_THR": 0.07,
            "COM_FAIL_ACT_T": 5.0,
            "THR_MDL_FAC": float(compensation),
            "MPC_THR_HOVER": float(hover_thrust),
        }
        self.setpoints: list[Setpoint] = []
        self.refused = 0
        self.violations: list[str] = []
        self._model = model
        self._compensation = ThrustModel(mass=1.0, gravity=1.0, hover_thrust=1.0, curve=compensation)
        self._motors = ThrustModel(model.mass, model.gravity, self._compensation.signal(hover_thrust), curve)
        self._active = wp.ones(1, dtype=int, device="cpu")
        self._command = wp.zeros((1, 1), dtype=wp.vec4, device="cpu")
        views = (self.vehicle.position, self.vehicle.velocity, self.vehicle.quaternion, self._command)
        # Arrays on the CPU, which share memory with the vehicle's.
        self._p, self._v, self._q, self._u = (view.numpy().reshape(-1) for view in views)
        self._offboard = OffboardControl()
        self._hold = HoldControl(model.mass, model.gravity, start)
        self._stream_start = self._last_setpoint_time = -math.inf
        self._dialect = load_dialect()
        self._protocol = self._new_protocol(0)
        self._loss_time = loss_time
        self._next_heartbeat = 0.0
        state, state_period = (_ATTITUDE_QUATERNION if pair else _ODOMETRY), 1.0 / _DEFAULT_STATE_RATE
        self._periodic_messages = {
            _EXTENDED_SYS_STATE: PeriodicMessage(self._landed_messages),
            _GPS_RAW_INT: PeriodicMessage(self._fix_messages, 1.0 / _FIX_RATE),
            _SYS_STATUS: PeriodicMessage(self._status_messages, 1.0),
            _BATTERY_STATUS: PeriodicMessage(self._battery_messages, 1.0),
            state: PeriodicMessage(self._state_messages, state_period),
        }
        self._on_ground = ground is not None
        self._takeoff_time, self._height_offset = takeoff_time, height_offset
        self._armed_at = self._companion_heard_at = self._lost_at = math.inf
        self._last_state: list[Any] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):  # without it, a setpoint arrives in the step that reads it
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._socket.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._address = address
        self.to_companion = Channel(self._deliver, seed=seed + 1)
        self.from_companion = Channel(self._receive, seed=seed + 2)
        self._now = 0.0
        self._arrival = 0.0  # of the datagram that is being handled
        self._datagrams: deque[tuple[float, bytes]] = deque()  # times of arrival and contents
        self._lockstep = lockstep
        self._start_time: float | None = None  # CLOCK_REALTIME at the start of the simulation [s]

    @property
    def position(self) -> NDArray[np.float64]:
        """True position [m], shape [3], world frame."""
        return self._p.astype(np.float64)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """True velocity [m/s], shape [3], world frame."""
        return self._v.astype(np.float64)

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """True attitude, body to world, w x y z, shape [4]."""
        return self._q.astype(np.float64)

    @property
    def mode_name(self) -> str:
        """Name of the mode."""
        return self.mode.name

    def local(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a position [m], shape [3], world frame, in the autopilot's own frame, which is the same."""
        return position

    @property
    def streaming(self) -> bool:
        """True if setpoints have been arriving for long enough to accept OFFBOARD."""
        is_current = self._now - self._last_setpoint_time <= self._loss_time
        return is_current and self._now - self._stream_start >= _STREAM_TIME

    @property
    def ready_to_arm(self) -> bool:
        """True once the companion computer has been running for long enough to know that the vehicle is disarmed."""
        return self._now - self._companion_heard_at >= _ARMING_TIME

    def arm(self) -> None:
        """Arm the vehicle and take off, as the pilot does."""
        self.armed, self._armed_at = True, self._now

    def engage(self) -> bool:
        """Switch to OFFBOARD, as the pilot does; return True if the autopilot accepts."""
        if not (self.armed and self.streaming and self._has_transmitter):
            return False
        self.mode = Mode.OFFBOARD
        self._offboard.engage()
        return True

    def lose_position(self, lost: bool = True) -> None:
        """Lose the GNSS fix, with which the estimated position drifts and grows uncertain, or find it again."""
        self._lost_at = self._now if lost else math.inf

    def lose_transmitter(self, lost: bool = True) -> None:
        """Lose the pilot's transmitter, which ends OFFBOARD unless COM_RCL_EXCEPT says otherwise, or hear it again."""
        self._has_transmitter = not lost
        if lost and self.mode is Mode.OFFBOARD and not int(self.parameters["COM_RCL_EXCEPT"]) & _EXCEPT_OFFBOARD:
            self.hold()

    def drain_battery(self) -> None:
        """Make the autopilot warn of a low battery from now on."""
        self._is_battery_low = True

    def hold(self) -> None:
        """Switch to HOLD, as the pilot or the autopilot's failsafe does."""
        self.mode = Mode.HOLD
        self._hold.engage()

    def start(self, *, late_by: float = 0.0) -> None:
        """Make the present, or a time `late_by` seconds ago, the time 0 of the simulation, except in lockstep."""
        if not self._lockstep:
            self._start_time = time.time() - late_by

    def step(self, tick: int, now: float) -> None:
        """Fly one step and exchange messages with the companion.

        Args:
            tick: number of the step.
            now: time at the end of the step, since the start of the simulation [s].
        """
        self._now = now
        self._drift += self.velocity_error * PERIOD
        self._receive_datagrams()
        if self.mode is Mode.OFFBOARD and now - self._last_setpoint_time > self._loss_time:
            self.hold()
        if self.armed:
            if self.mode is Mode.HOLD:
                self._u[:] = self._hold.control(self.position, self.velocity, self.quaternion)
            else:
                self._u[:] = self._offboard.control(self.quaternion, now)
            self.vehicle.fly(self._command, active=self._active, tick=tick)
        self._send_due_messages()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _receive_datagrams(self) -> None:
        while True:
            try:
                data, ancillary, _, _ = self._socket.recvmsg(2048, 64)
            except OSError:
                break
            arrival = self._now
            for level, kind, content in ancillary:
                if self._start_time is not None and (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                    seconds, nanoseconds = struct.unpack("@ll", content)
                    arrival = seconds - self._start_time + 1e-9 * nanoseconds
            self._datagrams.append((arrival, data))
        # A simulation that runs late must not obey a command before it was sent: keep the rest for later steps.
        while self._datagrams and self._datagrams[0][0] <= self._now:
            self._arrival, data = self._datagrams.popleft()
            self.from_companion.put(data, self._now)
        self._arrival = self._now
        self.from_companion.flush(self._now)

    def _new_protocol(self, sequence: int) -> Any:
        protocol = self._dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        protocol.robust_parsing, protocol.seq = True, sequence
        return protocol

    def _receive(self, data: bytes) -> None:
        try:
            messages = self._protocol.parse_buffer(data) or []
        except Exception:  # raised by pymavlink for corrupted bytes
            messages = []
        if self._protocol.buf_len():  # the rest of a corrupted datagram must not spoil the next one
            self._protocol = self._new_protocol(self._protocol.seq)
        for message in messages:
            name = message.get_type()
            if name != "BAD_DATA":
                self._companion_heard_at = min(self._companion_heard_at, self._now)
            if name == "SET_ATTITUDE_TARGET":
                self._handle_setpoint(message)
            elif name == "COMMAND_LONG":
                self._handle_command(message)
            elif name == "TIMESYNC" and message.tc1 == 0:
                self._send(self._dialect.MAVLink_timesync_message(int(1e9 * (_BOOT_TIME + self._now)), message.ts1))
            elif name == "PARAM_REQUEST_READ":
                self._send_parameter(str(message.param_id))
            elif name in PILOT_MESSAGES:
                self.violations.append(name)

    def _handle_setpoint(self, message: Any) -> None:
        setpoint = decode_setpoint(
            message,
            self._dialect,
            time=self._arrival,
            mode=self.mode,
            force=lambda signal: self._motors.force(self._compensation.signal(signal)),
        )
        if setpoint is None:
            self.refused += 1
            return
        if self._now - self._last_setpoint_time > self._loss_time:
            self._stream_start = self._now
        self._last_setpoint_time = self._now
        self.setpoints.append(setpoint)
        self._offboard.receive(setpoint, self._now)

    def _handle_command(self, message: Any) -> None:
        d = self._dialect
        if (message.command, message.param1) == (d.MAV_CMD_REQUEST_MESSAGE, d.MAVLINK_MSG_ID_HEARTBEAT):
            self._send_heartbeat()
            self._send(d.MAVLink_command_ack_message(message.command, d.MAV_RESULT_ACCEPTED))
            return
        if message.command != d.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.violations.append(f"COMMAND_LONG {message.command}")
            return
        periodic = self._periodic_messages.get(message.param1)
        result = d.MAV_RESULT_UNSUPPORTED
        if periodic is not None and message.param2 > 0.0:
            periodic.request(max(1e-6 * message.param2, 1.0 / _MAX_STATE_RATE), self._now)
            result = d.MAV_RESULT_ACCEPTED
        self._send(d.MAVLink_command_ack_message(message.command, result))

    def _send_parameter(self, name: str) -> None:
        """Send a parameter in PX4's encoding, in which a float carries the bits of an integer."""
        d = self._dialect
        if name not in self.parameters:
            return
        value, kind = self.parameters[name], d.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):
            value, kind = struct.unpack("<f", struct.pack("<i", value))[0], d.MAV_PARAM_TYPE_INT32
        self._send(d.MAVLink_param_value_message(name.encode(), value, kind, len(self.parameters), 0))

    def _send_heartbeat(self) -> None:
        d = self._dialect
        base = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (d.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        status = d.MAV_STATE_ACTIVE if self.armed else d.MAV_STATE_STANDBY
        kind = d.MAV_TYPE_QUADROTOR
        self._send(d.MAVLink_heartbeat_message(kind, d.MAV_AUTOPILOT_PX4, base, self.mode.value, status, 3))

    def _send_due_messages(self) -> None:
        self.to_companion.flush(self._now)
        if self._now >= self._next_heartbeat:
            self._next_heartbeat = self._now + 1.0
            self._send_heartbeat()
        for periodic in self._periodic_messages.values():
            for message in periodic.take_due(self._now):
                self._send(message)

    def _fix_messages(self) -> list[Any]:
        d = self._dialect
        kind = d.GPS_FIX_TYPE_3D_FIX if self._now < self._lost_at else d.GPS_FIX_TYPE_NO_GPS
        unknown = 2**16 - 1
        # The place on Earth is not simulated.
        return [d.MAVLink_gps_raw_int_message(int(1e6 * (_BOOT_TIME + self._now)), kind, 0, 0, 0, *[unknown] * 4, 255)]

    def _status_messages(self) -> list[Any]:
        d, unknown = self._dialect, 2**16 - 1
        present = d.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if self._has_transmitter else 0
        return [d.MAVLink_sys_status_message(present, present, present, 0, unknown, -1, -1, *[0] * 6)]

    def _battery_messages(self) -> list[Any]:
        d = self._dialect
        charge = d.MAV_BATTERY_CHARGE_STATE_LOW if self._is_battery_low else d.MAV_BATTERY_CHARGE_STATE_OK
        voltages, unknown = [2**16 - 1] * 10, -1
        # Number, function, type, temperature, voltages, current, consumed charge and energy, rest, time, state.
        return [d.MAVLink_battery_status_message(0, 0, 0, 2**15 - 1, voltages, *[unknown] * 4, 0, charge)]

    def _landed_messages(self) -> list[Any]:
        d = self._dialect
        return [d.MAVLink_extended_sys_state_message(d.MAV_VTOL_STATE_UNDEFINED, self._landed_state())]

    def _landed_state(self) -> int:
        d, start = self._dialect, self._hold.position
        if not self.armed:
            return d.MAV_LANDED_STATE_ON_GROUND if self._on_ground else d.MAV_LANDED_STATE_UNDEFINED
        if self._now - self._armed_at < self._takeoff_time:
            return d.MAV_LANDED_STATE_TAKEOFF
        if self._on_ground and start is not None and np.linalg.norm(self.position - start) > _START_RADIUS:
            return d.MAV_LANDED_STATE_TAKEOFF
        self._on_ground = False
        return d.MAV_LANDED_STATE_IN_AIR

    def _state_messages(self) -> list[Any]:
        if not (self.frozen and self._last_state):
            self._last_state = self._make_state_messages()
        return self._last_state

    def _make_state_messages(self) -> list[Any]:
        d = self._dialect
        stamp = _BOOT_TIME + self._now
        error = estimate_error(max(0.0, self._now - self._lost_at), height_offset=self._height_offset)
        west = np.array([0.0, 1.0, 0.0])
        p = ned_from_world(self.position + error.position + self._drift * west)
        v = ned_from_world(self.velocity + error.velocity + self.velocity_error * west)
        q = attitude_to_ned(self._q)
        rates = frd_from_flu(self.vehicle.control.numpy()[0, 1:])  # type: ignore[index]
        if _ODOMETRY not in self._periodic_messages:
            boot = int(1e3 * stamp)
            return [
                d.MAVLink_attitude_quaternion_message(boot, *q.tolist(), *rates.tolist()),
                d.MAVLink_local_position_ned_message(boot, *p.tolist(), *v.tolist()),
            ]
        frames = d.MAV_FRAME_LOCAL_NED, d.MAV_FRAME_LOCAL_NED
        motion = [*p.tolist(), q.tolist(), *v.tolist(), *rates.tolist()]
        covariances = covariance(error.position_std), covariance(error.velocity_std)
        return [d.MAVLink_odometry_message(int(1e6 * stamp), *frames, *motion, *covariances, 0, 0)]

    def _send(self, message: Any) -> None:
        data = bytes(message.pack(self._protocol))
        self._protocol.seq = (self._protocol.seq + 1) % 256
        self.to_companion.put(data, self._now)

    def _deliver(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens now; a real datagram would be lost, too
            self._socket.sendto(data, self._address)
