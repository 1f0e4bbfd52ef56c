"""The node's plans for viewers on the desk, over TCP. Read-only: what viewers send is thrown away.

A thread of its own encodes and sends. It takes the newest plan only, at most `telemetry.rate` times per second and only
while somebody looks; a viewer that is still busy with the message before skips one. The node hands over a reference and
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
from aero_planner.onboard.observer import Observer, PlanRecord
from aero_planner.onboard.safety_machine import Change
from aero_planner.onboard.settings import OnboardConfig, TelemetrySettings
from aero_planner.onboard.telemetry_protocol import Kind, encode
from aero_planner.plan import VehicleState

__all__ = ["POINT_STEP", "Telemetry", "encode_change", "encode_hello", "encode_plan"]

_log = logging.getLogger(__name__)

POINT_STEP = 0.01
"""Points are sent as whole multiples of this [m], from the drone's position on, in 16 bits."""

PLAN_ARRAYS = (
    "fine_range", "safe_range", "safe_direction", "filtered_points", "initial_endpoints", "anchors",
    "guide_coefficients", "guides", "controls", "positions", "velocities", "quaternions", "stage1_cost", "stage2_cost",
    "goal_cost", "collision_cost", "clearance",
)  # fmt: skip
"""Fields of `Plan` that are sent as they are."""

_CHANGES = 100
"""Transitions that may wait."""
_BACKLOG = 1 << 16
"""Bytes that a viewer may be behind and still be told of a transition."""
_PATIENCE = 10.0
"""Time without progress after which a viewer is given up [s]."""
_LARGEST_COORDINATE = 32767


class _Viewer:
    """A connection."""

    def __init__(self, connection: socket.socket, name: str, now: float) -> None:
        self.connection = connection
        self.name = name
        self.waiting = bytearray()
        self.progress = now


class Telemetry(Observer):
    """Serves viewers.

    Args:
        planner, onboard: configurations that the node flies with; `onboard.telemetry` says where to listen.
        clock: host time [s].

    Raises:
        OSError: the address or port can't be listened on.

    Attributes:
        port: TCP port that is listened on.
        sent: plans that were sent, counted once per viewer.
        skipped: plans that a viewer was too slow for.
    """

    def __init__(
        self, planner: PlannerConfig, onboard: OnboardConfig, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.sent = 0
        self.skipped = 0
        self._settings: TelemetrySettings = onboard.telemetry
        self._hello = encode_hello(planner, onboard)
        self._clock = clock
        self._next = -np.inf
        self._viewers: dict[socket.socket, _Viewer] = {}
        self._record: PlanRecord | None = None
        self._changes: deque[Change] = deque(maxlen=_CHANGES)
        self._closed = False
        family = socket.AF_INET6 if ":" in self._settings.host else socket.AF_INET
        self._server = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._server.bind((self._settings.host, self._settings.port))
            self._server.listen(self._settings.clients_max)
            self._server.setblocking(False)
        except BaseException:
            self._server.close()
            raise
        self.port: int = self._server.getsockname()[1]
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._server, selectors.EVENT_READ)
        self._bell, self._ear = socket.socketpair()
        for end in (self._bell, self._ear):
            end.setblocking(False)
        self._selector.register(self._ear, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="aero-planner-telemetry", daemon=True)
        self._thread.start()

    @property
    def viewers(self) -> int:
        """Number of viewers now."""
        return len(self._viewers)

    # --- called by the node -----------------------------------------------------------------------------------------

    def plan(self, record: PlanRecord) -> None:
        """Offer a plan."""
        now = self._clock()
        if self._viewers and now >= self._next:
            # A steady rate: the next one is due a period after this one was, if that is not long ago.
            period = 1.0 / self._settings.rate
            self._next = max(self._next + period, now + 0.5 * period)
            self._record = record
            self._ring()

    def change(self, change: Change) -> None:
        """Offer a transition."""
        if self._viewers:
            self._changes.append(change)
            self._ring()

    def close(self) -> None:
        """End all connections."""
        self._closed = True
        self._ring()
        self._thread.join(timeout=5.0)

    def _ring(self) -> None:
        with contextlib.suppress(OSError):  # full: it rings already; closed: nobody listens any more
            self._bell.send(b"\0")

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        lower_thread_priority()
        try:
            while not self._closed:
                for key, events in self._selector.select(timeout=1.0):
                    if key.fileobj is self._server:
                        self._accept()
                    elif key.fileobj is self._ear:
                        self._listen()
                    else:
                        self._serve(self._viewers.get(key.fileobj), events)  # type: ignore[arg-type]
                self._give_up_on_the_stuck()
        except Exception:
            _log.exception("telemetry ends here")
        finally:
            for viewer in list(self._viewers.values()):
                self._drop(viewer)
            for end in (self._server, self._bell, self._ear):
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
        viewer = _Viewer(connection, str(address[0]), self._clock())
        self._viewers[connection] = viewer
        self._selector.register(connection, selectors.EVENT_READ)
        _log.info("viewer %s connected", viewer.name)
        self._push(viewer, self._hello)

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            self._ear.recv(4096)
        while self._changes:
            data = encode_change(self._changes.popleft())
            for viewer in list(self._viewers.values()):
                if len(viewer.waiting) < _BACKLOG:
                    self._push(viewer, data)
        record, self._record = self._record, None
        if record is None:
            return
        free = [viewer for viewer in self._viewers.values() if not viewer.waiting]
        self.skipped += len(self._viewers) - len(free)
        if free:
            data = encode_plan(record, points_max=self._settings.points_max)
            self.sent += len(free)
            for viewer in free:
                self._push(viewer, data)

    def _serve(self, viewer: _Viewer | None, events: int) -> None:
        if viewer is None:
            return
        if events & selectors.EVENT_READ:
            try:
                if not viewer.connection.recv(65536):
                    return self._drop(viewer)
            except BlockingIOError:
                pass
            except OSError:
                return self._drop(viewer)
        if events & selectors.EVENT_WRITE:
            self._push(viewer, b"")

    def _push(self, viewer: _Viewer, data: bytes) -> None:
        viewer.waiting += data
        try:
            count = viewer.connection.send(viewer.waiting)
        except BlockingIOError:
            count = 0
        except OSError:
            return self._drop(viewer)
        if count:
            viewer.progress = self._clock()
            del viewer.waiting[:count]
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if viewer.waiting else 0)
        if self._selector.get_key(viewer.connection).events != wanted:
            self._selector.modify(viewer.connection, wanted)

    def _give_up_on_the_stuck(self) -> None:
        now = self._clock()
        for viewer in list(self._viewers.values()):
            if viewer.waiting and now - viewer.progress > _PATIENCE:
                self._drop(viewer)

    def _drop(self, viewer: _Viewer) -> None:
        if self._viewers.pop(viewer.connection, None) is not None:
            self._selector.unregister(viewer.connection)
            viewer.connection.close()
            _log.info("viewer %s is gone", viewer.name)


def encode_hello(planner: PlannerConfig, onboard: OnboardConfig) -> bytes:
    """Return the message that a viewer gets first."""
    return encode(Kind.HELLO, {"planner": planner.to_dict(), "onboard": onboard.to_dict()})


def encode_change(change: Change) -> bytes:
    """Return a transition as a message."""
    values = {"time": change.time, "source": change.source.name, "target": change.target.name}
    return encode(Kind.CHANGE, {**values, "cause": change.cause.value})


def encode_plan(record: PlanRecord, *, points_max: int) -> bytes:
    """Return a plan and what it was made from as a message, with `points_max` points at most."""
    plan, state = record.plan, record.measured
    position = np.asarray(state.position, dtype=np.float64)
    stride = -(-len(record.points) // points_max) if points_max else 0
    points = record.points[::stride] if stride else record.points[:0]
    offsets = np.rint((points - position.astype(np.float32)) / POINT_STEP)
    offsets = np.nan_to_num(offsets, nan=_LARGEST_COORDINATE).clip(-_LARGEST_COORDINATE, _LARGEST_COORDINATE)
    arrays: dict[str, Any] = {name: getattr(plan, name) for name in PLAN_ARRAYS}
    arrays |= _state_arrays("measured", state) | _state_arrays("state", record.state)
    arrays |= {"goal": record.goal, "points": offsets.astype(np.int16)}
    values = {
        "number": record.number,
        "time": record.time,
        "kinds": list(plan.kinds),
        "best": int(plan.best),
        "status": int(plan.status),  # type: ignore[arg-type]
        "dropped_points": int(plan.dropped_points),
        "stage_ms": plan.stage_ms,
        "plan_ms": record.plan_ms,
        "cloud_age": record.cloud_age,
        "sweeps": record.sweeps,
        "safety": record.safety.name,
        "missing": [cause.value for cause in record.missing],
        "late_ticks": record.late_ticks,
    }
    return encode(Kind.PLAN, values, arrays)


def _state_arrays(name: str, state: VehicleState) -> dict[str, Any]:
    return {
        f"{name}.{part}": np.asarray(getattr(state, part), dtype=np.float64)
        for part in ("position", "velocity", "quaternion", "time")
    }
