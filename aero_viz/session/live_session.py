"""A drone that flies elsewhere, as a session for the dashboard."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.session.broadcast import Steerable
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.node_client import READ_ONLY, LiveSource, NodeClient

__all__ = ["LiveSession"]

_log = logging.getLogger(__name__)

_KEPT = 300
"""Frames from before a pause that can be returned to, and as many after it: half a minute each at 10 Hz."""
_OLD = 1.5
"""Age from which on the page tells how old the newest plan is [s]."""
_LOOK = 0.25
"""Time between two looks at that age [s]."""
_RETRY = 1.0
"""Time between two attempts to connect again [s]."""


class LiveSession(Steerable):
    """A drone in the place of `aero_viz.session.Session`, for the dashboard: looks on, and can hold still and go back.

    Args:
        client: the connection; closed with the session. When it ends, another is tried every second.
        reconnect: makes another connection; None stays with the first.
    """

    def __init__(self, client: NodeClient, *, reconnect: Callable[[], NodeClient] | None = None) -> None:
        super().__init__()
        self._playing = True
        self._client = client
        self._in_sight = True
        self._reconnect = reconnect
        self._kept: deque[Frame] = deque()
        self._waiting: Frame | None = None
        """The newest frame, where the pause has left no room for it among the kept ones."""
        self._chosen: Frame | None = None
        """Of the kept ones, the one that is shown."""
        self._shown: Frame | None = None
        """The same, with what the page is told besides."""
        self._arrived = 0.0
        """When the newest frame came [s]."""
        self._told_age = 0
        """Age of the newest frame that `_shown` tells [s]; 0: none."""
        self._epoch = 0
        self._closed = threading.Event()
        self._lock = threading.RLock()
        self._threads = [
            threading.Thread(target=target, name=f"aero-viz-live-{name}", daemon=True)
            for name, target in (("listen", self._run), ("age", self._watch_age))
        ]

    # --- what anyone may read ---------------------------------------------------------------------------------------

    read_only = True

    @property
    def waiting(self) -> str:
        """Whether the drone can be heard, and what it plans from."""
        name = self._client.name
        if not self._in_sight:
            return f"{name} is out of sight, and had not planned yet."
        return (
            f"Connected to {name}, which has not planned yet: for that it needs states from the autopilot, points from "
            "the LiDAR, and a goal."
        )

    @property
    def frame(self) -> Frame | None:
        """The frame to be shown."""
        return self._shown

    @property
    def source(self) -> LiveSource:
        """What is known of the drone."""
        shown = self._shown
        if shown is not None:
            return shown.source  # type: ignore[return-value]
        return LiveSource(self._client.name, 1.0 / self._client.onboard.rates.replan, np.zeros(3))

    @property
    def config(self) -> PlannerConfig:
        """The configuration that the drone flies with."""
        return self._client.config

    @property
    def speed(self) -> float:
        """A drone's time is everyone's."""
        return 1.0

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""
        with self._lock:
            return (self._kept[0].time, self._kept[-1].time) if self._kept else (0.0, 0.0)

    # --- what the page may do ---------------------------------------------------------------------------------------

    def play(self) -> None:
        """Follow the drone again."""
        with self._lock:
            self._set_playing(True)
            if self._waiting is not None:
                self._kept, self._waiting = deque([self._waiting]), None
            if self._kept:
                self._jump_to(self._kept[-1])

    def pause(self) -> None:
        """Hold the picture; the drone flies on."""
        with self._lock:
            self._set_playing(False)

    def step(self, count: int = 1) -> Future[Any]:
        """Hold the picture and go `count` frames on, or back when negative, half a minute from the pause at most."""
        with self._lock:
            self._set_playing(False)
            if self._chosen is not None:
                place = self._kept.index(self._chosen) + count
                self._jump_to(self._kept[min(max(place, 0), len(self._kept) - 1)])
        return _done()

    def seek(self, time: float) -> Future[Any]:
        """Show the frame at or before `time` [s], or the oldest that is kept."""
        with self._lock:
            earlier = [frame for frame in self._kept if frame.time <= time + 1e-9]
            if self._kept:
                self._jump_to(earlier[-1] if earlier else self._kept[0])
        return _done()

    def set_samples(self, wanted: bool) -> Future[Any]:
        """Samples stay on the drone."""
        if wanted:
            self.notify("The drone does not send its samples: they would fill the link.")
        return _done()

    def set_speed(self, speed: float) -> None:
        """A drone's time can't be changed."""
        self.notify("The drone flies in its own time; pause, and step or go back, to look closer.", level="error")

    def set_goal(self, position: Any, *, quiet: bool = False) -> Future[Any]:
        """The goal is the drone's; see `Session.set_goal`."""
        return self._refuse(quiet=quiet)

    def set_source(self, source: Any) -> Future[Any]:
        """There is no other source than the drone."""
        return self._refuse()

    def configure(self, change: Any) -> PlannerConfig:
        """The settings are the drone's.

        Raises:
            UserError: always.
        """
        raise UserError(READ_ONLY)

    def undo(self) -> PlannerConfig:
        """See `configure`."""
        raise UserError(READ_ONLY)

    def redo(self) -> PlannerConfig:
        """See `configure`."""
        raise UserError(READ_ONLY)

    def _refuse(self, *, quiet: bool = False) -> Future[Any]:
        if not quiet:
            self.notify(READ_ONLY, level="error")
        future: Future[Any] = Future()
        future.set_exception(UserError(READ_ONLY))
        return future

    def _jump_to(self, frame: Frame) -> None:
        self._epoch += 1
        self._show(frame)

    def _show(self, frame: Frame) -> None:
        self._chosen = frame
        self._told_age = self._age()
        told: dict[str, Any] = {"epoch": self._epoch}
        if self._told_age:
            words = (frame.explanation, f"The newest plan is {self._told_age} s old.")
            told |= {"rate": 0.0, "explanation": " ".join(filter(None, words))}
        self._shown = dataclasses.replace(frame, **told)
        self._frames.publish(self._shown)

    def _age(self) -> int:
        """Age of the newest frame in whole seconds, 0 for one that is new enough."""
        age = time.monotonic() - self._arrived
        return round(age) if age > _OLD else 0

    # --- listening --------------------------------------------------------------------------------------------------

    def start(self, *, play: bool = True) -> None:
        """Start to listen."""
        self._set_playing(play)
        for thread in self._threads:
            thread.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                for item in self._client:
                    self._take(item)
                reason = "the connection has ended"
            except UserError as error:
                reason = str(error)
            self._client.close()
            if self._closed.is_set():
                return
            self._in_sight = False
            _log.warning("%s: %s", self._client.name, reason)
            self.notify(f"The drone is out of sight: {reason}", level="error")
            if self._reconnect is None or not self._find_again():
                return

    def _find_again(self) -> bool:
        assert self._reconnect is not None
        while not self._closed.wait(_RETRY):
            with contextlib.suppress(UserError):
                client = self._reconnect()
                self._client, self._in_sight = client, True
                self.notify("The drone is in sight again.")
                return True
        return False

    def _take(self, item: Frame | Notice) -> None:
        if isinstance(item, Notice):
            self._notices.publish(item)
            return
        with self._lock:
            self._arrived = time.monotonic()
            another = bool(self._kept) and self._kept[-1].source is not item.source  # connected again
            if not self._playing and (another or len(self._kept) >= 2 * _KEPT):
                self._waiting = item  # what is held to be studied stays
            else:
                if another:
                    self._kept.clear()
                    self._epoch += 1
                self._kept.append(item)
                while self._playing and len(self._kept) > _KEPT:
                    self._kept.popleft()
            if self._playing or self._chosen is None:
                self._show(item)

    def _watch_age(self) -> None:
        """Tell the page, where no frame comes, how old the newest one is; and that it no longer is."""
        while not self._closed.wait(_LOOK):
            with self._lock:
                if self._chosen is not None and self._told_age != self._age():
                    self._show(self._chosen)

    def close(self) -> None:
        """End the connection and the sinks."""
        self._closed.set()
        self._client.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self.close_sinks()


def _done() -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(None)
    return future
