"""Client of `aero-planner run`: turns its telemetry into frames. Nothing is sent but what `DroneTuning` asks for."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from aero_planner import Goal, Plan, PlannerConfig, PlanStatus, Sweeps, VehicleState
from aero_planner.mission_progress import MissionEvent
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import PLAN_ARRAYS, POINT_STEP
from aero_planner.onboard.telemetry_protocol import Kind, Message, MessageReader
from aero_viz.errors import UserError
from aero_viz.session.drone_tuning import DroneTuning
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.source import Observation, SourceInfo

_CHUNK = 1 << 18
_RATE_WINDOW = 2.0
"""Time over which the rate of plans is measured [s]."""
_KEEPALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPALIVE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""Silence before the first probe [s] (its names on Linux and macOS), time between probes [s], failures allowed."""
_NOTICE = "Live: this is the drone's own plan. The page controls nothing but what the node lets the Tune tab change."


class NodeClient:
    """Connection to a node.

    Args:
        host: name or address of the drone.
        port: TCP port; `telemetry.port` in the node's settings.
        key: key of those who may change parameters; None only watches.
        timeout: longest wait for the connection and for the first message [s].

    Raises:
        UserError: the port is out of range, nothing answers there, or what answers is not a node of this release.
    """

    def __init__(self, host: str, port: int = 14650, *, key: bytes | None = None, timeout: float = 5.0) -> None:
        self.name = f"{host}:{port}"
        """Address of the node."""
        self.config: PlannerConfig
        """Configuration of the drone's planner, as far as it was received."""
        self.onboard: OnboardConfig
        """Settings of the node."""
        self.tuning: DroneTuning
        """Changes of the planner's parameters."""
        self._reader = MessageReader()
        self._ready: deque[Message] = deque()
        if not 0 < port < 1 << 16:
            raise UserError(f"{self.name} has no valid port; give one from 1 to 65535, that of telemetry.port.")
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout)
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise UserError(
                f"No node answers at {self.name}: {reason}; start `aero-planner run` there, and set its "
                "telemetry.host to an address that this computer can reach."
            ) from error
        try:
            try:
                hello = self._receive(deadline=time.monotonic() + timeout)
            except TimeoutError as error:
                raise UserError(f"Something listens at {self.name} but sends no greeting; it is not a node.") from error
            except OSError:
                hello = None
            if hello is None or hello.kind != Kind.HELLO:
                raise UserError(f"The node at {self.name} accepts no further viewer, or is not a node.")
            try:
                self.config = PlannerConfig.from_dict(hello.values["planner"])
                settings = hello.values["onboard"].items()
                self.onboard = OnboardConfig().replace(
                    {f"{section}.{name}": value for section, values in settings for name, value in values.items()}
                )
                self.tuning = DroneTuning(hello.values, self.onboard, key, self._socket.sendall)
            except (KeyError, AttributeError, ValueError) as error:
                raise UserError(
                    f"The node at {self.name} has other settings than this program knows ({error}); install the same "
                    "release on both computers."
                ) from error
            self._socket.settimeout(None)
            _keep_alive(self._socket)
        except BaseException:
            self._socket.close()
            raise
        self._frames = _FrameMaker(self.name, self.config, 1.0 / self.onboard.rates.replan)

    def __iter__(self) -> Iterator[Frame | Notice]:
        """Yield frames, and a notice for each transition of the safety state and each end of a leg, until the end.

        A node without a goal may be silent for any time. A node that the network no longer reaches counts as lost
        after a few seconds.

        Raises:
            UserError: the connection is lost, or a message is damaged.
        """
        while (message := self._next()) is not None:
            if message.kind == Kind.CHANGE:
                yield _notice(message)
            elif message.kind == Kind.EVENT:
                yield _leg_notice(message, self.name)
            elif message.kind == Kind.STATUS:
                yield from self._take_status(message)
            elif message.kind == Kind.PLAN:
                try:
                    frame = self._frames.make(message)
                except Exception as error:  # whoever answers there may send anything
                    raise UserError(f"The node at {self.name} sent a malformed plan: {error!r}.") from error
                yield frame

    def close(self) -> None:
        """Close the connection, which also ends an iteration in another thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _take_status(self, message: Message) -> list[Notice]:
        try:
            notices = self.tuning.receive(message)
            state = self.tuning.state
            if self._frames.version != state.version:
                self.config = self.config.replace(state.values)
                self._frames.config, self._frames.version = self.config, state.version
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise UserError(f"The node at {self.name} sent malformed parameters: {error!r}.") from error
        return notices

    def _next(self) -> Message | None:
        """Return the next message, None at the end of the connection."""
        try:
            return self._receive()
        except OSError as error:
            if self._socket.fileno() < 0:  # by `close`
                return None
            reason = error.strerror or str(error)
            raise UserError(f"the connection to {self.name} is lost: {reason}.") from error

    def _receive(self, *, deadline: float | None = None) -> Message | None:
        """Return the next message, None at the end; TimeoutError if it is not complete at the deadline [s]."""
        while not self._ready:
            if deadline is not None:
                self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            data = self._socket.recv(_CHUNK)
            if not data:
                return None
            try:
                self._ready.extend(self._reader.feed(data))
            except ValueError as error:
                raise UserError(f"{self.name}: {error}") from error
        return self._ready.popleft()


def _keep_alive(connection: socket.socket) -> None:
    """Let the system probe the connection: a peer that only receives cannot notice a lost link otherwise.

    A time that the platform cannot set keeps its system default.
    """
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if (option := getattr(socket, name, None)) is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)


class _FrameMaker:
    """Turns messages into frames."""

    def __init__(self, name: str, config: PlannerConfig, period: float) -> None:
        self._name, self._period = name, period
        self.config, self.version = config, 0
        self._source: SourceInfo | None = None
        self._start_time = 0.0
        self._trail = np.empty((1024, 3), dtype=np.float32)
        self._count = 0
        self._recent: deque[tuple[float, int]] = deque()

    def make(self, message: Message) -> Frame:
        values, arrays = message.values, message.arrays
        measured, time = _state(arrays, "measured"), float(values["time"])
        position = np.asarray(measured.position)
        if self._source is None:
            self._start_time = time
            self._source = SourceInfo(
                self._name, closed_loop=True, period=self._period, start=position, notices=(_NOTICE,)
            )
        points = (position + arrays["points"] * POINT_STEP).astype(np.float32).reshape(-1, 3)
        observation = Observation(
            time=time - self._start_time,
            state=measured,
            goal=Goal(arrays["goal"].reshape(3)),
            sweeps=Sweeps(np.array_split(points, max(int(values["sweeps"]), 1))),
            cloud_age=float(values["cloud_age"]),
        )
        disturbance, continued = values.get("disturbance"), arrays.get("continued_cells")  # an older node has neither
        plan_arrays: dict[str, Any] = {name: arrays[name] for name in PLAN_ARRAYS}
        plan = Plan(
            **plan_arrays,
            continued_cells=None if continued is None else continued != 0,
            kinds=tuple(values["kinds"]),
            best=int(values["best"]),
            status=PlanStatus(values["status"]),
            dropped_points=int(values["dropped_points"]),
            disturbance=None if disturbance is None else np.array(disturbance, dtype=np.float32),
            drag=values.get("drag"),
            stage_ms=dict(values["stage_ms"]),
        )
        plan.command  # noqa: B018 - raises an error if the shapes are inconsistent
        return Frame(
            index=int(values["number"]),
            time=observation.time,
            observation=observation,
            plan=plan,
            config=self.config,
            config_version=self.version,
            outcome=None,
            explanation=_explanation(State[values["safety"]], values["missing"]) + _leg(values),
            timings_ms={"observe": 0.0, "plan": float(values["plan_ms"]), "advance": 0.0},
            rate=self._rate(time, int(values["number"])),
            dropped_ticks=int(values["late_ticks"]),
            trail=self._extend_trail(position),
            epoch=0,
            source=self._source,
        )

    def _rate(self, time: float, number: int) -> float:
        """Return the recent rate of plans [Hz], including plans that were not sent."""
        self._recent.append((time, number))
        while time - self._recent[0][0] > _RATE_WINDOW:
            self._recent.popleft()
        first_time, first_number = self._recent[0]
        return (number - first_number) / (time - first_time) if time > first_time else 0.0

    def _extend_trail(self, position: NDArray[np.float64]) -> NDArray[np.float32]:
        if self._count == len(self._trail):
            self._trail = np.concatenate((self._trail, np.empty_like(self._trail)))
        self._trail[self._count] = position
        self._count += 1
        trail = self._trail[: self._count]
        trail.flags.writeable = False
        return trail


def _state(arrays: Mapping[str, Any], name: str) -> VehicleState:
    position, velocity, quaternion, time = (
        arrays[f"{name}.{part}"] for part in ("position", "velocity", "quaternion", "time")
    )
    return VehicleState(position.reshape(3), velocity.reshape(3), quaternion.reshape(4), None, float(time))


def _leg(values: Mapping[str, Any]) -> str:
    """Return which waypoint is flown to; nothing of a node without a mission, or an older one."""
    if values.get("waypoint") is None:
        return ""
    number, count = int(values["waypoint"]) + 1, int(values["waypoints"])
    return f" Waypoint {number} of {count}." if number <= count else f" All {count} waypoints are done."


def _explanation(state: State, missing: list[str]) -> str:
    return f"{state.name}: {state.value}{''.join(f'; {cause}' for cause in missing)}."


def _leg_notice(message: Message, name: str) -> Notice:
    try:
        event = MissionEvent.from_dict(message.values)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"The node at {name} sent a malformed event of its mission: {error!r}.") from error
    return Notice("failure" if event.kind == "given_up" else "info", event.text)


def _notice(message: Message) -> Notice:
    values = message.values
    target = str(values.get("target"))
    level: Literal["info", "error"] = "error" if target in (State.BRAKING.name, State.HANDED_BACK.name) else "info"
    return Notice(level, f"{values.get('source')} → {target}: {values.get('cause')}")
