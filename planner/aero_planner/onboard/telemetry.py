"""Telemetry server: sends the node's plans over TCP to viewers; who holds a key may change parameters.

A thread encodes and sends. It sends only the newest plan, at most `telemetry.rate` times per second, and only while
there is a viewer. A viewer that is still receiving the previous message skips one. The node hands over a reference and
never waits.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from aero_planner.config import PlannerConfig
from aero_planner.mailbox import lower_thread_priority
from aero_planner.mission_progress import MissionEvent
from aero_planner.onboard.interfaces import ConfigChange, Observation, Observer, PlanRecord
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.settings import OnboardConfig, TelemetrySettings
from aero_planner.onboard.telemetry_protocol import Kind, encode
from aero_planner.onboard.tuning import Tuning
from aero_planner.onboard.tuning_link import TuningLink
from aero_planner.plan import VehicleState

_log = logging.getLogger(__name__)

POINT_STEP = 0.01
"""Points are sent as 16-bit multiples of this step [m], relative to the drone's position."""

PLAN_ARRAYS = (
    "fine_range", "safe_range", "safe_direction", "filtered_points", "initial_endpoints", "anchors",
    "guide_coefficients", "guides", "controls", "positions", "velocities", "quaternions", "stage1_cost", "temperature",
    "stage2_cost", "goal_cost", "collision_cost", "clearance",
)  # fmt: skip
"""Fields of `Plan` that are sent unchanged."""

_CHANGES = 100
"""Largest number of transitions and ends of legs that wait."""
_BACKLOG = 1 << 16
"""Largest number of unsent bytes with which a viewer is still sent a transition."""
_STALL_TIMEOUT = 10.0
"""Time without progress after which a viewer is disconnected [s]."""
_STATUS_PERIOD = 0.25
"""Time between two reports of the parameters [s]."""
_LARGEST_COORDINATE = 32767


class _Viewer:
    """A connection to a viewer."""

    def __init__(self, connection: socket.socket, name: str, now: float, tuning: Tuning | None) -> None:
        self.connection = connection
        self.name = name
        self.link = None if tuning is None else TuningLink(tuning, name)
        self.unsent = bytearray()
        self.last_progress = now


class Telemetry(Observer):
    """Serves viewers.

    Args:
        planner: Configuration of the planner, which viewers receive first.
        onboard: Configuration of the node; `onboard.telemetry` says where to listen.
        tuning: What viewers may change; None discards what they send.
        clock: Host time [s].

    Raises:
        OSError: The address or port can't be listened on.

    Attributes:
        port: TCP port that the server listens on.
        sent: Number of plans sent, counted once per viewer.
        accepted: Number of plans passed to the thread for sending.
        skipped: Number of plans for which a viewer was too slow.
    """

    def __init__(
        self,
        planner: PlannerConfig,
        onboard: OnboardConfig,
        *,
        tuning: Tuning | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.sent = 0
        self.accepted = 0
        self.skipped = 0
        self._settings: TelemetrySettings = onboard.telemetry
        self._hello = {"planner": planner.to_dict(), "onboard": onboard.to_dict()}
        self._tuning, self._next_status = tuning, -np.inf
        self._clock = clock
        self._next_plan = -np.inf
        self._viewers: dict[socket.socket, _Viewer] = {}
        self._record: PlanRecord | None = None
        self._changes: deque[StateChange | MissionEvent] = deque(maxlen=_CHANGES)
        self._closed = False
        self._server = listen(self._settings)
        self.port: int = self._server.getsockname()[1]
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        # A byte into one end wakes up the thread, which waits at the other end.
        self._wake_up, self._wake_up_end = socket.socketpair()
        for end in (self._wake_up, self._wake_up_end):
            end.setblocking(False)
        self._selector.register(self._wake_up_end, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="aero-planner-telemetry", daemon=True)
        self._thread.start()

    @property
    def viewers(self) -> int:
        """Number of connected viewers."""
        return len(self._viewers)

    # --- called by the node ---

    def observe(self, item: Observation) -> None:
        """Offer a plan or a change; anything else is ignored."""
        if not self._viewers:
            return
        if isinstance(item, StateChange | MissionEvent):
            self._changes.append(item)
            self._notify_thread()
        elif isinstance(item, ConfigChange):
            self._next_status = -np.inf
            self._notify_thread()
        elif isinstance(item, PlanRecord) and (now := self._clock()) >= self._next_plan:
            # At a steady rate: the next plan is due one period after this one was due, unless that was long ago.
            period = 1.0 / self._settings.rate
            self._next_plan = max(self._next_plan + period, now + 0.5 * period)
            self._record = item
            self.accepted += 1
            self._notify_thread()

    def close(self) -> None:
        """Close all connections."""
        self._closed = True
        self._notify_thread()
        self._thread.join(timeout=5.0)

    def _notify_thread(self) -> None:
        with contextlib.suppress(OSError):  # the buffer is full, so the thread will wake up; or the socket is closed
            self._wake_up.send(b"\0")

    # --- the thread ---

    def _run(self) -> None:
        lower_thread_priority()
        try:
            while not self._closed:
                for key, events in self._selector.select(timeout=1.0 if self._tuning is None else _STATUS_PERIOD):
                    if key.fileobj is self._server:
                        self._accept()
                    elif key.fileobj is self._wake_up_end:
                        self._send_new()
                    else:
                        self._serve(self._viewers.get(key.fileobj), events)  # type: ignore[arg-type]
                self._drop_stalled()
                if self._tuning is not None and time.monotonic() >= self._next_status:
                    self._send_status()
        except Exception:
            _log.exception("the telemetry server has failed and ends")
        finally:
            for viewer in list(self._viewers.values()):
                self._drop(viewer)
            for end in (self._server, self._wake_up, self._wake_up_end):
                end.close()
            self._selector.close()

    def _accept(self) -> None:
        try:
            connection, address = self._server.accept()
        except OSError:
            return
        if len(self._viewers) >= self._settings.clients_max:
            connection.close()
            return
        connection.setblocking(False)
        viewer = _Viewer(connection, str(address[0]), self._clock(), self._tuning)
        self._viewers[connection] = viewer
        self._selector.register(connection, selectors.EVENT_READ)
        _log.info("viewer %s connected", viewer.name)
        self._push(viewer, encode(Kind.HELLO, self._hello | ({} if viewer.link is None else viewer.link.greeting)))

    def _send_new(self) -> None:
        """Send the transitions, the ends of legs and the newest plan that the node has offered."""
        with contextlib.suppress(OSError):
            self._wake_up_end.recv(4096)
        while self._changes:
            change = self._changes.popleft()
            data = _encode_change(change)
            for viewer in list(self._viewers.values()):
                if len(viewer.unsent) < _BACKLOG:
                    self._push(viewer, data)
        record, self._record = self._record, None
        if record is None:
            return
        idle = [viewer for viewer in self._viewers.values() if not viewer.unsent]
        self.skipped += len(self._viewers) - len(idle)
        if idle:
            data = encode_plan(record, points_max=self._settings.points_max)
            self.sent += len(idle)
            for viewer in idle:
                self._push(viewer, data)

    def _send_status(self) -> None:
        """Tell every viewer about the parameters; one that is still receiving something else is told next time."""
        self._next_status = time.monotonic() + _STATUS_PERIOD
        for viewer in list(self._viewers.values()):
            if viewer.link is not None and len(viewer.unsent) < _BACKLOG:
                self._push(viewer, viewer.link.status())

    def _serve(self, viewer: _Viewer | None, events: int) -> None:
        if viewer is None:
            return
        if events & selectors.EVENT_READ:
            try:
                data = viewer.connection.recv(65536)
                if not data:
                    return self._drop(viewer)
                if viewer.link is not None and viewer.link.receive(data):
                    self._next_status = -np.inf
            except BlockingIOError:
                pass
            except OSError:
                return self._drop(viewer)
        if events & selectors.EVENT_WRITE:
            self._push(viewer, b"")

    def _push(self, viewer: _Viewer, data: bytes) -> None:
        viewer.unsent += data
        try:
            count = viewer.connection.send(viewer.unsent)
        except BlockingIOError:
            count = 0
        except OSError:
            return self._drop(viewer)
        if count:
            viewer.last_progress = self._clock()
            del viewer.unsent[:count]
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if viewer.unsent else 0)
        if self._selector.get_key(viewer.connection).events != events:
            self._selector.modify(viewer.connection, events)

    def _drop_stalled(self) -> None:
        now = self._clock()
        for viewer in list(self._viewers.values()):
            if viewer.unsent and now - viewer.last_progress > _STALL_TIMEOUT:
                self._drop(viewer)

    def _drop(self, viewer: _Viewer) -> None:
        if self._viewers.pop(viewer.connection, None) is not None:
            self._selector.unregister(viewer.connection)
            viewer.connection.close()
            if viewer.link is not None:
                viewer.link.abandon()
            _log.info("viewer %s disconnected", viewer.name)


def listen(settings: TelemetrySettings) -> socket.socket:
    """Return a non-blocking socket that listens; OSError if the address or port can't be used."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    server = socket.socket(family, socket.SOCK_STREAM)
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((settings.host, settings.port))
        server.listen(settings.clients_max)
        server.setblocking(False)
    except BaseException:
        server.close()
        raise
    return server


def _encode_change(change: StateChange | MissionEvent) -> bytes:
    if isinstance(change, MissionEvent):
        return encode(Kind.EVENT, vars(change))
    values = {"time": change.time, "source": change.source.name, "target": change.target.name}
    return encode(Kind.CHANGE, {**values, "cause": change.cause.value})


def encode_plan(record: PlanRecord, *, points_max: int) -> bytes:
    """Return the message of a plan and its inputs, with at most `points_max` points."""
    plan, state = record.plan, record.measured
    position = np.asarray(state.position, dtype=np.float64)
    stride = -(-len(record.points) // points_max) if points_max else 0
    points = record.points[::stride] if stride else record.points[:0]
    offsets = np.rint((points - position.astype(np.float32)) / POINT_STEP)
    offsets = np.nan_to_num(offsets, nan=_LARGEST_COORDINATE).clip(-_LARGEST_COORDINATE, _LARGEST_COORDINATE)
    arrays: dict[str, Any] = {name: getattr(plan, name) for name in PLAN_ARRAYS}
    arrays |= _state_arrays("measured", state) | _state_arrays("state", record.state)
    arrays |= {"goal": record.goal, "points": offsets.astype(np.int16)}
    if plan.continued_cells is not None:
        arrays["continued_cells"] = plan.continued_cells.astype(np.uint8)
    values = {
        "number": record.number,
        "time": record.time,
        "kinds": list(plan.kinds),
        "best": int(plan.best),
        "status": int(plan.status),  # type: ignore[arg-type]
        "dropped_points": int(plan.dropped_points),
        "disturbance": None if plan.disturbance is None else plan.disturbance.tolist(),
        "drag": plan.drag,
        "stage_ms": plan.stage_ms,
        "plan_ms": record.plan_ms,
        "cloud_age": record.cloud_age,
        "sweeps": record.sweeps,
        "safety": record.safety.name,
        "missing": [cause.value for cause in record.missing],
        "late_ticks": record.late_ticks,
        "waypoint": None if record.mission is None else record.mission.index,
        "waypoints": None if record.mission is None else len(record.mission.mission),
    }
    return encode(Kind.PLAN, values, arrays)


def _state_arrays(prefix: str, state: VehicleState) -> dict[str, Any]:
    return {
        f"{prefix}.{name}": np.asarray(getattr(state, name), dtype=np.float64)
        for name in ("position", "velocity", "quaternion", "time")
    }
