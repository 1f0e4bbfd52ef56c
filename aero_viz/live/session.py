"""The session of a stream: it plans on while the picture is held, moved back in time, or planned again."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.errors import UserError
from aero_viz.live.record import Recorder
from aero_viz.live.setup import Setup
from aero_viz.live.source import StreamSource
from aero_viz.session.engine import Engine
from aero_viz.session.frame import Frame
from aero_viz.session.publisher import Publisher
from aero_viz.session.session import Session

_TICKS_MAX = 4096
"""Ticks that may wait for a sink: minutes."""
_REST_DELAY, _REST_POLL = 10.0, 0.5
"""Time for which nobody looks before a stream rests, and between two looks for somebody who returns [s]."""
_CLOSE_TIMEOUT = 10.0
"""Longest wait for a slow disk at the end of a recording [s]."""


class StreamEngine(Engine):
    """Plans the newest tick of a stream, whatever is shown.

    A plan for the picture, such as that of an earlier tick with other weights, leaves no trace in the next live plan.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.follows = True
        """True if the newest tick is shown."""
        self._head: Any = None
        """State of the planner after the newest tick."""

    def tick(self) -> Frame:
        """Go to the newest messages and plan. The frame is published if the picture follows."""
        shown = None if self.follows or not self._timeline else (self.frame, self._timeline.index)
        if shown is not None:
            self._timeline.go_by(self._timeline.earlier + len(self._timeline))
        try:
            if self._head is not None:
                self._planner.restore(self._head)
            started = time.perf_counter()
            self.source.advance(None)  # type: ignore[arg-type]
            frame = self._plan(advance_ms=1e3 * (time.perf_counter() - started), is_shown=shown is None)
            self._head = self._planner.history()
        finally:
            if shown is not None:
                self.frame = shown[0]
                self._timeline.go_by(shown[1] - self._timeline.index)
                self.source.restore(self._timeline.current.source)
        return frame

    def follow(self) -> None:
        """Show the newest tick from the next one on."""
        self.follows = True
        self._epoch += 1
        self._timeline.go_by(self._timeline.earlier + len(self._timeline))

    def forget(self) -> None:
        """Let the next live plan build on none before it, so that a recording that begins with it is complete."""
        self._planner.reset(seed=self.seed)
        self._head = self._planner.history()


class StreamSession(Session):
    """Plans a stream at its rate, for as long as it is open.

    `pause`, `step` and `seek` hold the picture at a tick, which is then planned again where the configuration changes;
    `play` returns to the newest one. With a pinned configuration, A plans the ticks that are shown as well, as far as
    there is time.

    Args:
        source, config, device, seed: see `Session`.
    """

    _engine_type = StreamEngine
    _engine: StreamEngine

    def __init__(
        self, source: StreamSource, *, config: DroneConfig | None = None, device: str = "cpu", seed: int = 0
    ) -> None:
        self.stream_source = source
        """The stream."""
        self._ticks = Publisher[Frame]()
        self._due, self._ticks_alone = 0.0, False
        self.rests = False
        """True while nothing is planned since nobody uses it; see `rest_unless`."""
        self._is_shown: Callable[[], bool] = lambda: True
        self._tell_rest: Callable[[bool], None] = lambda rests: None
        self._used, self._rest_delay = 0.0, _REST_DELAY
        self.recorder: Recorder | None = None
        """Writes the stream; None while nothing is recorded."""
        super().__init__(source, config=config, device=device, seed=seed)
        self._playing = True

    @property
    def is_stream(self) -> bool:
        return True

    def subscribe_ticks(self, callback: Callable[[Frame], None], *, name: str) -> Mailbox[Frame]:
        """Call `callback` with every live tick, whatever is shown, on a separate thread, until `unsubscribe`."""
        return self._ticks.subscribe(callback, capacity=_TICKS_MAX, name=name)

    def unsubscribe(self, sink: Mailbox[Any], *, timeout: float = 0.0) -> None:
        self._ticks.unsubscribe(sink, timeout=timeout)
        super().unsubscribe(sink, timeout=timeout)

    def rest_unless(
        self, is_shown: Callable[[], bool], tell: Callable[[bool], None], *, delay: float = _REST_DELAY
    ) -> None:
        """Plan nothing while the picture is held, nothing is recorded and nobody looks. Call it before `start`.

        Args:
            is_shown: returns True if somebody looks.
            tell: called with True when the rest begins and with False when it ends, before the next plan.
            delay: time for which nobody looks before the rest begins [s].
        """
        self._is_shown, self._tell_rest, self._rest_delay = is_shown, tell, delay

    def play(self) -> None:
        """Return to the newest tick, and follow the stream."""

        def command() -> None:
            if not self._engine.follows:
                self._engine.follow()
            self._set_playing(True)

        self._post(command)

    def pause(self) -> None:
        """Hold the picture; the stream is planned and recorded all the same."""
        self._post(self._hold)

    def _hold(self) -> None:
        self._engine.follows = False
        self._set_playing(False)

    def step(self, count: int = 1) -> Future[Any]:
        """Hold the picture and move by `count` ticks, backward if negative."""

        def command() -> None:
            self._hold()
            self._engine.step_back(-count)

        return self._post(command)

    def seek(self, time: float) -> Future[Any]:
        """Hold the picture at the tick at or before `time` [s], or the oldest one kept."""

        def command() -> None:
            self._hold()
            self._engine.seek(time)

        return self._post(command)

    def set_speed(self, speed: float) -> None:
        """Raise UserError: a stream has its own speed."""
        raise UserError("A live stream has a speed of its own; record it, and play the recording slower.")

    def set_goal(self, position: ArrayLike, *, quiet: bool = False) -> Future[Any]:
        """Move the goal, of the next live tick and of the tick that is held."""
        if not self._engine.follows:
            return super().set_goal(position, quiet=quiet)
        return self._post(lambda: self.stream_source.set_goal(position), quiet=quiet)

    def _stop_to_compare(self) -> None:
        """Do nothing: the stream goes on."""

    def fly_both(self) -> Future[Any]:
        """Fail: nothing can fly in a stream."""

        def command() -> None:
            raise UserError("A stream cannot be flown by another plan; compare A and B tick by tick.")

        return self._post(command)

    def use(self, setup: Setup) -> Future[Any]:
        """Read the messages otherwise from the next tick on."""
        return self._post(lambda: self.stream_source.use(setup))

    def record(self, path: str | Path) -> Future[Recorder]:
        """Write what arrives and what is planned from the next tick on, until `stop_recording` or `close`.

        The future has a UserError if the file cannot be written, or another one is being written.
        """

        def command() -> Recorder:
            if self.recorder is not None:
                raise UserError(f"{self.recorder.path} is being recorded; stop that first.")
            recorder = Recorder(path, self.stream_source.stream, seed=self.seed, failed=self._recording_failed)
            self._engine.forget()
            recorder.sink = self._ticks.subscribe(recorder.put, capacity=_TICKS_MAX, name="recorder")
            self.recorder = recorder
            return recorder

        return self._post(command)

    def stop_recording(self) -> Future[Any]:
        """Finish the file that is being recorded, if there is one."""
        return self._post(self._finish_recording)

    def _finish_recording(self) -> None:
        recorder, self.recorder = self.recorder, None
        if recorder is None:
            return
        self._ticks.unsubscribe(recorder.sink, timeout=_CLOSE_TIMEOUT)
        recorder.close(dropped=recorder.sink.dropped)
        self.notify(f"Recorded {recorder.ticks} ticks: aero-viz play {recorder.path}")

    def _recording_failed(self, text: str) -> None:
        self.notify(text, level="error")

    def _tick(self) -> Frame:
        self._due = max(self._due + self.source.period, time.monotonic())
        frame = self._engine.tick()
        self._ticks.publish(frame)
        return frame

    def start(self, *, play: bool = True) -> None:
        """Start the thread that plans. Without `play`, the first tick is held."""

        def first() -> None:
            self._due = self._used = time.monotonic()
            if self._try_tick() and not play:
                self._hold()

        self._ticks_alone = True
        self._loop.start(first, name="aero-viz-stream")

    def _idle_time(self) -> float | None:
        self._rest_if_unused()
        if self._must_compare():
            return 0.0
        return _REST_POLL if self.rests else max(self._due - time.monotonic(), 0.0)

    def _rest_if_unused(self) -> None:
        now = time.monotonic()
        if self._engine.follows or self.recorder is not None or self._is_shown():
            self._used = now
        rests = now - self._used > self._rest_delay
        if rests != self.rests:
            self.rests, self._due = rests, now
            self._tell_rest(rests)

    def _must_compare(self) -> bool:
        return self.comparison.has_work

    def _work(self) -> None:
        if self._ticks_alone and not self.rests and time.monotonic() >= self._due:
            self._try_live_tick()
        elif self._must_compare():
            super()._work_on_comparison()

    def _try_live_tick(self) -> None:
        try:
            self._tick()
        except Exception as error:  # the stream goes on, and the next tick may go well
            self._report(error)

    def close(self) -> None:
        with contextlib.suppress(CancelledError):  # it was closed before
            self.stop_recording().result()
        self._ticks.close()
        super().close()
