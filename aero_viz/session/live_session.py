"""Session that shows the live plans of a drone in flight."""

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

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.session.base import BaseSession, completed
from aero_viz.session.drone_tuning import DroneTuning
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.node_client import NodeClient

_log = logging.getLogger(__name__)

_KEPT = 300
"""Frames kept from before a pause, and as many from after it: half a minute each at 10 Hz."""
_STALE_AGE = 1.5
"""Age of the newest plan from which it is shown to the user [s]."""
_AGE_CHECK_PERIOD = 0.25
"""Time between two checks of that age [s]."""
_RETRY_PERIOD = 1.0
"""Time between two attempts to reconnect [s]."""


class LiveSession(BaseSession):
    """Follows a drone in flight. The picture can be paused and moved back in time; all that reaches the drone are the
    changes that `tuning` asks for.

    Args:
        client: the connection; closed with the session. If it ends, the session reconnects once per second.
        reconnect: opens another connection; None never reconnects.
    """

    def __init__(self, client: NodeClient, *, reconnect: Callable[[], NodeClient] | None = None) -> None:
        super().__init__(playing=True)
        self._client = client
        self._connected = True
        self._reconnect = reconnect
        self._kept: deque[Frame] = deque()
        self._overflow: Frame | None = None
        """The newest frame, if the pause has filled `_kept`."""
        self._current: Frame | None = None
        """The kept frame that is shown."""
        self._shown: Frame | None = None
        """`_current` with the epoch and the explanation that the page shows."""
        self._last_arrival = 0.0
        """Time at which the newest frame arrived [s]."""
        self._shown_age = 0
        """Age of the newest frame according to `_shown` [s]; 0 if it is recent."""
        self._epoch = 0
        self._closed = threading.Event()
        self._lock = threading.RLock()
        self._listener = threading.Thread(target=self._run, name="aero-viz-live-listen", daemon=True)
        self._age_watcher = threading.Thread(target=self._watch_age, name="aero-viz-live-age", daemon=True)

    # --- state ------------------------------------------------------------------------------------------------------

    @property
    def controls(self) -> None:
        """None: a drone in flight takes no commands from here."""
        return None

    @property
    def tuning(self) -> DroneTuning:
        return self._client.tuning

    @property
    def waiting_message(self) -> str:
        name = self._client.name
        if not self._connected:
            return f"The connection to {name} was lost before its first plan."
        return (
            f"Connected to {name}, which has not planned yet: it needs states from the autopilot, points from the "
            "LiDAR, and a goal."
        )

    @property
    def frame(self) -> Frame | None:
        return self._shown

    @property
    def config(self) -> PlannerConfig:
        return self._client.config

    @property
    def time_range(self) -> tuple[float, float]:
        with self._lock:
            return (self._kept[0].time, self._kept[-1].time) if self._kept else (0.0, 0.0)

    # --- playback ---------------------------------------------------------------------------------------------------

    def play(self) -> None:
        """Follow the drone again."""
        with self._lock:
            self._set_playing(True)
            if self._overflow is not None:
                self._kept, self._overflow = deque([self._overflow]), None
            if self._kept:
                self._jump_to(self._kept[-1])

    def pause(self) -> None:
        """Hold the picture; the drone flies on."""
        with self._lock:
            self._set_playing(False)

    def step(self, count: int = 1) -> Future[Any]:
        """Hold the picture and move by `count` frames, backward if negative; half a minute from the pause at most."""
        with self._lock:
            self._set_playing(False)
            if self._current is not None:
                place = self._kept.index(self._current) + count
                self._jump_to(self._kept[min(max(place, 0), len(self._kept) - 1)])
        return completed()

    def seek(self, time: float) -> Future[Any]:
        """Show the frame at or before `time` [s], or the oldest one kept."""
        with self._lock:
            earlier = [frame for frame in self._kept if frame.time <= time + 1e-9]
            if self._kept:
                self._jump_to(earlier[-1] if earlier else self._kept[0])
        return completed()

    def _jump_to(self, frame: Frame) -> None:
        self._epoch += 1
        self._show(frame)

    def _show(self, frame: Frame) -> None:
        self._current = frame
        self._shown_age = self._stale_age()
        changes: dict[str, Any] = {"epoch": self._epoch}
        if self._shown_age:
            sentences = (frame.explanation, f"The newest plan is {self._shown_age} s old.")
            changes |= {"rate": 0.0, "explanation": " ".join(filter(None, sentences))}
        self._shown = dataclasses.replace(frame, **changes)
        self._frames.publish(self._shown)

    def _stale_age(self) -> int:
        """Return the age of the newest frame in whole seconds, 0 if it is recent."""
        age = time.monotonic() - self._last_arrival
        return round(age) if age > _STALE_AGE else 0

    # --- connection -------------------------------------------------------------------------------------------------

    def start(self, *, play: bool = True) -> None:
        """Start to receive frames."""
        self._set_playing(play)
        self._listener.start()
        self._age_watcher.start()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                for item in self._client:
                    self._receive(item)
                reason = "the drone closed it"
            except UserError as error:
                reason = str(error)
            self._client.close()
            if self._closed.is_set():
                return
            self._connected = False
            _log.warning("%s: %s", self._client.name, reason)
            self.notify(f"The connection to the drone is lost: {reason}", level="error")
            if self._reconnect is None or not self._try_to_reconnect(self._reconnect):
                return

    def _try_to_reconnect(self, reconnect: Callable[[], NodeClient]) -> bool:
        while not self._closed.wait(_RETRY_PERIOD):
            with contextlib.suppress(UserError):
                client = reconnect()
                with self._lock:
                    if self._closed.is_set():
                        client.close()
                        return False
                    self._client, self._connected = client, True
                self.notify("The drone is connected again.")
                return True
        return False

    def _receive(self, item: Frame | Notice) -> None:
        if isinstance(item, Notice):
            self._notices.publish(item)
            return
        with self._lock:
            self._last_arrival = time.monotonic()
            reconnected = bool(self._kept) and self._kept[-1].source is not item.source
            if not self._playing and (reconnected or len(self._kept) >= 2 * _KEPT):
                self._overflow = item  # a pause keeps the frames that are being studied
            else:
                if reconnected:
                    self._kept.clear()
                    self._epoch += 1
                self._kept.append(item)
                while self._playing and len(self._kept) > _KEPT:
                    self._kept.popleft()
            if self._playing or self._current is None:
                self._show(item)

    def _watch_age(self) -> None:
        """Publish the current frame again whenever the age that it shows is out of date."""
        while not self._closed.wait(_AGE_CHECK_PERIOD):
            with self._lock:
                if self._current is not None and self._shown_age != self._stale_age():
                    self._show(self._current)

    def close(self) -> None:
        """Close the connection and the sinks."""
        with self._lock:
            self._closed.set()
        self._client.close()
        # An attempt to reconnect cannot be interrupted and may take seconds: the thread then ends, and closes what it
        # has opened, on its own.
        for thread in (self._listener, self._age_watcher) if self._connected else (self._age_watcher,):
            if thread.is_alive():
                thread.join(timeout=5.0)
        self.close_sinks()
