"""A drone's live plan on the desk: the telemetry of `aero-planner run` as frames. Read-only: nothing is sent there."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from aero_planner import Goal, Plan, PlannerConfig, PlanStatus, VehicleState
from aero_planner.onboard.safety_machine import State
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import PLAN_ARRAYS, POINT_STEP
from aero_planner.onboard.telemetry_protocol import Kind, Message, MessageReader
from aero_viz.errors import UserError
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.source import Observation, Scenery

__all__ = ["READ_ONLY", "LiveSource", "NodeClient"]

_CHUNK = 1 << 18
_RATE_WINDOW = 2.0
"""Time over which plans are counted [s]."""
_KEEPALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPALIVE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""Silence before the first probe [s], by its names on Linux and macOS; time between two [s]; probes that may fail."""
READ_ONLY = "The drone flies with its own settings; nothing can be changed from here."


class LiveSource:
    """What the dashboard reads of a drone; it implements the attributes of `aero_viz.session.source.Source`.

    Args:
        name: of the node.
        period: of its plans [s].
        start: first known position [m], shape [3].
    """

    closed_loop = True
    times: NDArray[np.float64] | None = None
    outcome: str | None = None
    explanation: str | None = None

    def __init__(self, name: str, period: float, start: Any) -> None:
        self.name = name
        self.period = period
        told = ("Live: this is the drone's own plan. The page looks on and steers nothing.",)
        self.scenery = Scenery(start=np.asarray(start, dtype=np.float64), notices=told)

    def observe(self) -> Observation:
        """Frames come by themselves."""
        raise TypeError(READ_ONLY)

    def advance(self, plan: Plan) -> None:
        """The drone flies by itself."""
        raise TypeError(READ_ONLY)

    def checkpoint(self) -> object:
        """A flight that happens can't be repeated."""
        raise TypeError(READ_ONLY)

    def restore(self, checkpoint: object) -> None:
        """See `checkpoint`."""
        raise TypeError(READ_ONLY)

    def seek(self, time: float) -> None:
        """See `checkpoint`."""
        raise TypeError(READ_ONLY)

    def set_goal(self, position: Any) -> None:
        """The goal is the drone's."""
        raise UserError(READ_ONLY)

    def close(self) -> None:
        """Nothing to release."""


class NodeClient:
    """A connection to a node.

    Args:
        host: name or address of the drone.
        port: TCP port, `telemetry.port` of its settings.
        timeout: longest wait for the connection and the first message [s].

    Raises:
        UserError: nobody answers there, or somebody who is no node of this release.

    Attributes:
        config: of the planner on the drone.
        onboard: settings of the node.
    """

    def __init__(self, host: str, port: int = 14650, *, timeout: float = 5.0) -> None:
        self.name = f"{host}:{port}"
        self._reader = MessageReader()
        self._ready: deque[Message] = deque()
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout)
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise UserError(
                f"No node answers at {self.name}: {reason}; start `aero-planner run` there, and let its "
                "telemetry.host be an address that this computer reaches."
            ) from error
        try:
            try:
                hello = self._receive()
            except TimeoutError as error:
                raise UserError(f"Something answers at {self.name}, but says nothing; it is no node.") from error
            except OSError:
                hello = None
            if hello is None or hello.kind != Kind.HELLO:
                raise UserError(f"The node at {self.name} has no room for another viewer, or is no node.")
            try:
                self.config = PlannerConfig.from_dict(hello.values["planner"])
                settings = hello.values["onboard"].items()
                self.onboard = OnboardConfig().replace(
                    {f"{section}.{name}": value for section, values in settings for name, value in values.items()}
                )
            except (KeyError, AttributeError, ValueError) as error:
                raise UserError(
                    f"The node at {self.name} has other settings than this program knows ({error}); install the same "
                    "release on both."
                ) from error
            self._socket.settimeout(None)
            _keep_alive(self._socket)
        except BaseException:
            self._socket.close()
            raise
        self._frames = _FrameMaker(self.name, self.config, 1.0 / self.onboard.rates.replan)

    def __iter__(self) -> Iterator[Frame | Notice]:
        """Yield frames, and a notice for each transition of the drone's safety state, until the connection ends.

        A node without a goal is silent for as long as it likes; one that the network no longer leads to is given up
        after a few seconds.

        Raises:
            UserError: the connection is lost, or what comes is damaged.
        """
        while (message := self._next()) is not None:
            if message.kind == Kind.CHANGE:
                yield _notice(message)
            elif message.kind == Kind.PLAN:
                try:
                    frame = self._frames.make(message)
                except (KeyError, IndexError, TypeError, ValueError) as error:
                    raise UserError(f"What the node at {self.name} sends is no plan: {error!r}.") from error
                yield frame

    def close(self) -> None:
        """End the connection; an iteration in another thread ends, too."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _next(self) -> Message | None:
        """Return the next message, None when there will be none."""
        try:
            return self._receive()
        except OSError as error:
            if self._socket.fileno() < 0:  # closed by us
                return None
            reason = error.strerror or str(error)
            raise UserError(f"the connection to {self.name} is lost: {reason}.") from error

    def _receive(self) -> Message | None:
        while not self._ready:
            data = self._socket.recv(_CHUNK)
            if not data:
                return None
            try:
                self._ready.extend(self._reader.feed(data))
            except ValueError as error:
                raise UserError(f"{self.name}: {error}") from error
        return self._ready.popleft()


def _keep_alive(connection: socket.socket) -> None:
    """Let the system ask the other end whether it is still there: who only reads learns of a lost link in no other way.

    Where the platform can't set one of the times, its own holds.
    """
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if (option := getattr(socket, name, None)) is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)


class _FrameMaker:
    """Makes frames of messages."""

    def __init__(self, name: str, config: PlannerConfig, period: float) -> None:
        self._name, self._config, self._period = name, config, period
        self._source: LiveSource | None = None
        self._began = 0.0
        self._trail = np.empty((1024, 3), dtype=np.float32)
        self._count = 0
        self._recent: deque[tuple[float, int]] = deque()

    def make(self, message: Message) -> Frame:
        values, arrays = message.values, message.arrays
        measured, when = _state(arrays, "measured"), float(values["time"])
        position = np.asarray(measured.position)
        if self._source is None:
            self._began = when
            self._source = LiveSource(self._name, self._period, position)
        points = (position + arrays["points"] * POINT_STEP).astype(np.float32).reshape(-1, 3)
        observation = Observation(
            time=when - self._began,
            state=measured,
            goal=Goal(arrays["goal"].reshape(3)),
            points=points,
            sweep_count=int(values["sweeps"]),
            cloud_age=float(values["cloud_age"]),
        )
        plan = Plan(
            **{name: arrays[name] for name in PLAN_ARRAYS},
            kinds=tuple(values["kinds"]),
            best=int(values["best"]),
            status=PlanStatus(values["status"]),
            dropped_points=int(values["dropped_points"]),
            stage_ms=dict(values["stage_ms"]),
        )
        plan.command  # noqa: B018 - raises where the parts do not fit each other
        return Frame(
            index=int(values["number"]),
            time=observation.time,
            observation=observation,
            plan=plan,
            config=self._config,
            config_version=0,
            outcome=None,
            explanation=_explanation(State[values["safety"]], values["missing"]),
            timings_ms={"observe": 0.0, "plan": float(values["plan_ms"]), "advance": 0.0},
            rate=self._rate(when, int(values["number"])),
            dropped_ticks=int(values["late_ticks"]),
            trail=self._moved_to(position),
            epoch=0,
            source=self._source,
        )

    def _rate(self, when: float, number: int) -> float:
        """Plans per second lately, also those that were not sent."""
        self._recent.append((when, number))
        while when - self._recent[0][0] > _RATE_WINDOW:
            self._recent.popleft()
        first, count = self._recent[0]
        return (number - count) / (when - first) if when > first else 0.0

    def _moved_to(self, position: Any) -> Any:
        if self._count == len(self._trail):
            self._trail = np.concatenate((self._trail, np.empty_like(self._trail)))
        self._trail[self._count] = position
        self._count += 1
        trail = self._trail[: self._count]
        trail.flags.writeable = False
        return trail


def _state(arrays: Mapping[str, Any], name: str) -> VehicleState:
    position, velocity, quaternion, when = (
        arrays[f"{name}.{part}"] for part in ("position", "velocity", "quaternion", "time")
    )
    return VehicleState(position.reshape(3), velocity.reshape(3), quaternion.reshape(4), None, float(when))


def _explanation(state: State, missing: list[str]) -> str:
    return f"{state.name}: {state.value}{''.join(f'; {cause}' for cause in missing)}."


def _notice(message: Message) -> Notice:
    values = message.values
    target = str(values.get("target"))
    level: Literal["info", "error"] = "error" if target in (State.BRAKING.name, State.HANDED_BACK.name) else "info"
    return Notice(level, f"{values.get('source')} → {target}: {values.get('cause')}")
