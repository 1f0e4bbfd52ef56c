"""The engine: drives source -> planner -> Frame at a fixed tick, headless, and hands frames to sinks."""

from __future__ import annotations

import dataclasses
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Literal

import numpy as np

from aero_planner import Planner, PlannerConfig
from aero_viz.config_history import ConfigHistory
from aero_viz.errors import UserError
from aero_viz.frame import Frame, Notice
from aero_viz.sinks import Publisher, Sink
from aero_viz.source import Source
from aero_viz.timeline import Mark, Timeline

__all__ = ["Frame", "Notice", "Session"]

_log = logging.getLogger(__name__)


class Session:
    """Owns a source, a planner and the clock.

    Either call `tick` yourself, as fast as you like, or `start` a thread that keeps time and control it from any thread
    with `play`, `pause`, `step`, `seek`, `speed` and the setters. Commands take effect between two ticks.

    Args:
        source: where sweeps and states come from; closed with the session.
        config: of the planner.
        device: of the planner.
        seed: of the planner's noise.
    """

    def __init__(
        self, source: Source, *, config: PlannerConfig | None = None, device: str = "cpu", seed: int = 0
    ) -> None:
        self._source = source
        self._config = config or PlannerConfig()
        self._planner = Planner(self._config, device=device, seed=seed)
        self._configs = ConfigHistory(self._config)
        self._commands: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._frames = Publisher()
        self._notices = Publisher()
        self._frame: Frame | None = None
        self._playing = False
        self._speed = 1.0
        self._samples = False
        self._epoch = 0
        self._forget()

    def _forget(self) -> None:
        """Start anew at the source's present tick."""
        self._timeline = Timeline()
        self._dropped = 0
        self._ended = False
        self._tick_ends: deque[float] = deque(maxlen=200)
        self._next_due = time.monotonic()
        self._epoch += 1

    # --- what anyone may read ---------------------------------------------------------------------------------------

    @property
    def frame(self) -> Frame | None:
        """The newest frame."""
        return self._frame

    @property
    def source(self) -> Source:
        """The source in use; only read its attributes."""
        return self._source

    @property
    def config(self) -> PlannerConfig:
        """The configuration that the next tick will use."""
        return self._configs.present[0]

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._playing

    @property
    def speed(self) -> float:
        """Source time per wall time."""
        return self._speed

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""
        times = self._source.times
        if times is not None and len(times):
            return float(times[0]), float(times[-1])
        return self._timeline.time_range

    # --- sinks ------------------------------------------------------------------------------------------------------

    def subscribe(self, callback: Callable[[Frame], None], *, every: bool = False, name: str = "frames") -> Sink:
        """Call `callback` with the newest frame, from a thread of its own; with `every`, with each frame as long as
        fewer than 256 wait. Close the returned sink to end it."""
        sink = self._frames.subscribe(callback, capacity=256 if every else 1, name=name)
        if self._frame is not None:
            sink.put(self._frame)
        return sink

    def subscribe_notices(self, callback: Callable[[Notice], None]) -> Sink:
        """Call `callback` with each notice, from a thread of its own."""
        return self._notices.subscribe(callback, capacity=64, name="notices")

    def unsubscribe(self, sink: Sink) -> None:
        """Close a sink and forget it."""
        self._frames.unsubscribe(sink)
        self._notices.unsubscribe(sink)

    def notify(self, text: str, *, level: Literal["info", "error"] = "info") -> None:
        """Send a notice to everyone."""
        self._notices.publish(Notice(level, text))

    # --- commands, from any thread ----------------------------------------------------------------------------------

    def play(self) -> None:
        """Let time go on."""

        def command() -> None:
            self._playing = True
            self._next_due = time.monotonic()

        self._post(command)

    def pause(self) -> None:
        """Hold time; parameters still act on the plan."""
        self._post(self._set_paused)

    def _set_paused(self) -> None:
        self._playing = False

    def step(self, count: int = 1) -> Future[Any]:
        """Pause and go `count` ticks on, or back when negative."""

        def command() -> None:
            self._playing = False
            if count < 0:
                self._go_back(-count)
            for _ in range(count):
                self.tick()

        return self._post(command)

    def seek(self, time: float) -> Future[Any]:
        """Go to the tick at or before `time` [s]. A flight can go back to any tick flown, and from there on
        differently."""
        return self._post(lambda: self._seek(time))

    def set_speed(self, speed: float) -> None:
        """Set source time per wall time; ValueError unless it lies in [0.01, 100]."""
        if not 0.01 <= speed <= 100.0:
            raise ValueError(f"speed is {speed:g}; it must be in [0.01, 100].")
        self._speed = float(speed)

    def set_goal(self, position: Any) -> Future[Any]:
        """Move the goal [m], shape [3], world frame."""
        goal = np.asarray(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"goal is {position!r}; it must be three finite numbers [m].")

        def command() -> None:
            self._source.set_goal(goal)
            self._replan()

        return self._post(command)

    def set_source(self, source: Source) -> Future[Any]:
        """Go on with another source from its start. If its first tick fails, the present one stays."""
        return self._post(lambda: self._exchange(source))

    def set_samples(self, wanted: bool) -> Future[Any]:
        """Let frames carry the Stage I samples or not."""

        def command() -> None:
            self._samples = wanted
            self._replan()

        return self._post(command)

    def configure(self, change: PlannerConfig | Mapping[str, Any]) -> PlannerConfig:
        """Use another configuration, or the present one with some parameters changed, from the next tick on.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the present configuration stays.
        """
        config = self._configs.change(change)
        self._post(self._replan_if_changed)
        return config

    def undo(self) -> PlannerConfig:
        """Return to the configuration before the present one."""
        return self._go_to_config(-1)

    def redo(self) -> PlannerConfig:
        """Return to the configuration that `undo` left."""
        return self._go_to_config(+1)

    def _go_to_config(self, step: int) -> PlannerConfig:
        config = self._configs.go(step)
        self._post(self._replan_if_changed)
        return config

    def _post(self, command: Callable[[], Any]) -> Future[Any]:
        """Run `command` between two ticks; at once when no thread keeps the time."""
        future: Future[Any] = Future()
        if self._thread is None or threading.current_thread() is self._thread:
            self._run_command(command, future)
        else:
            self._commands.put((command, future))
        return future

    def _run_command(self, command: Callable[[], Any], future: Future[Any]) -> None:
        try:
            future.set_result(command())
        except Exception as error:
            future.set_exception(error)
            self._report(error)

    def _report(self, error: Exception) -> None:
        self.notify(str(error) or type(error).__name__, level="error")
        if not isinstance(error, UserError | ValueError):
            _log.error("a command failed", exc_info=error)

    # --- one tick ---------------------------------------------------------------------------------------------------

    def tick(self) -> Frame:
        """Advance the source by the last plan, observe, plan, publish. At the end the last frame is returned again."""
        if self._frame is None or not self._timeline:
            return self._plan(mark=True)
        if self._source.outcome is not None:
            self._finish()
            return self._frame
        started = time.perf_counter()
        self._source.advance(self._frame.plan)
        advance_ms = 1e3 * (time.perf_counter() - started)
        if self._source.outcome == "end":
            # A recording that is over has no further tick: what is on screen stays.
            frame = dataclasses.replace(self._frame, outcome="end")
            self._publish(frame)
            return frame
        return self._plan(mark=True, advance_ms=advance_ms)

    def _plan(self, *, mark: bool, advance_ms: float = 0.0) -> Frame:
        config, version = self._configs.present
        started = time.perf_counter()
        observation = self._source.observe()
        observed = time.perf_counter()
        if config is not self._config:
            self._planner.configure(config)
            self._config = config
        history = self._planner.history()
        plan = self._planner.plan(observation.state, observation.goal, observation.points, samples=self._samples)
        planned = time.perf_counter()
        if mark:
            position = (observation.true_state or observation.state).position
            self._timeline.append(Mark(observation.time, self._source.checkpoint(), history), position)
        timings = {"observe": 1e3 * (observed - started), "plan": 1e3 * (planned - observed), "advance": advance_ms}
        self._tick_ends.append(planned)
        frame = Frame(
            index=self._timeline.index,
            time=observation.time,
            observation=observation,
            plan=plan,
            config=config,
            config_version=version,
            outcome=self._source.outcome,
            timings_ms=timings,
            rate=self._rate(),
            dropped_ticks=self._dropped,
            trail=self._timeline.trail(),
            epoch=self._epoch,
        )
        self._publish(frame)
        return frame

    def _publish(self, frame: Frame) -> None:
        self._frame = frame
        self._frames.publish(frame)

    def _rate(self) -> float:
        now = self._tick_ends[-1]
        recent = [end for end in self._tick_ends if now - end <= 1.0]
        return (len(recent) - 1) / (now - recent[0]) if len(recent) > 1 and now > recent[0] else 0.0

    def _replan(self) -> Frame | None:
        """Plan the present tick again, as if for the first time."""
        if not self._timeline:
            return None
        self._planner.restore(self._timeline.present.history)
        return self._plan(mark=False)

    def _replan_if_changed(self) -> None:
        # Of many changes in a row only the last one is planned.
        if not self._playing and self.config is not self._config:
            self._replan()

    # --- jumps in time ----------------------------------------------------------------------------------------------

    def _seek(self, wanted: float) -> None:
        if not np.isfinite(wanted):
            raise ValueError(f"time is {wanted}; it must be a finite number [s].")
        if self._source.times is not None:
            self._source.seek(wanted)
            self._planner.reset()
            self._forget()
            self._plan(mark=True)
        elif self._timeline:
            self._return_to(self._timeline.go_to_time(wanted))

    def _go_back(self, count: int) -> None:
        times = self._source.times
        if times is not None and self._frame is not None and self._timeline.position_in_marks < count:
            row = int(np.searchsorted(times, self._frame.time + 1e-9, side="right")) - 1
            self._seek(float(times[max(row - count, 0)]))
        elif self._timeline:
            self._return_to(self._timeline.go_by(-count))

    def _return_to(self, mark: Mark) -> None:
        self._source.restore(mark.checkpoint)
        self._planner.restore(mark.history)
        self._epoch += 1
        self._ended = False
        self._next_due = time.monotonic()
        self._plan(mark=False)

    def _exchange(self, source: Source) -> None:
        before = (self._source, self._timeline, self._planner.history())
        self._source = source
        self._planner.reset()
        self._forget()
        try:
            self._plan(mark=True)
        except Exception:
            self._source, self._timeline, history = before
            self._planner.restore(history)
            source.close()
            raise
        before[0].close()

    # --- keeping time -----------------------------------------------------------------------------------------------

    def start(self, *, play: bool = True) -> None:
        """Start the thread that keeps time."""
        if self._thread is not None:
            raise RuntimeError("the session was already started.")
        self._playing = play
        self._next_due = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="aero-viz-session", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.tick()
        except Exception as error:
            self._report(error)
            self._playing = False
        while True:
            delay = max(0.0, self._next_due - time.monotonic()) if self._playing else None
            try:
                item = self._commands.get(timeout=delay)
            except queue.Empty:
                self._timed_tick()
                continue
            if item is None:
                return
            self._run_command(*item)

    def _timed_tick(self) -> None:
        before = self._frame.time if self._frame else 0.0
        try:
            self._skip_late_ticks()
            frame = self.tick()
        except Exception as error:
            self._playing = False
            self._report(error)
            return
        if frame.outcome is not None and self._source.outcome is not None:
            self._finish()
        gap = frame.time - before
        self._next_due += (gap if gap > 0.0 else self._source.period) / self._speed
        if not self._source.closed_loop:
            return
        late = time.monotonic() - self._next_due
        if late > self._source.period / self._speed:
            # A flight is never skipped: it runs slower than the clock and says so.
            self._dropped += 1
            self._next_due = time.monotonic()

    def _skip_late_ticks(self) -> None:
        """Keep a recording in step with the clock by skipping ticks when planning takes too long."""
        times, frame = self._source.times, self._frame
        if times is None or frame is None or self._source.outcome is not None:
            return
        now = frame.time + (time.monotonic() - self._next_due) * self._speed + self._source.period
        row = int(np.searchsorted(times, frame.time + 1e-9, side="right"))
        target = int(np.searchsorted(times, now, side="right")) - 1
        if target - row > 1:
            self._source.seek(float(times[target - 1]))
            self._next_due = time.monotonic()
            self._dropped += target - row

    def _finish(self) -> None:
        """Hold at the end and say how it came, once."""
        self._playing = False
        if not self._ended:
            self._ended = True
            self.notify(f"{self._source.name}: {_OUTCOMES.get(self._source.outcome or '', self._source.outcome)}")

    def close(self) -> None:
        """End the thread, the sinks, the source and the planner."""
        if self._thread is not None:
            self._commands.put(None)
            self._thread.join(timeout=10.0)
            self._thread = None
        self._frames.close()
        self._notices.close()
        self._source.close()
        self._planner.close()


_OUTCOMES = {
    "arrived": "arrived at the goal.",
    "collision": "collided with an obstacle.",
    "stall": "stalled: no progress toward the goal.",
    "out_of_bounds": "left the world.",
    "timeout": "ran out of time.",
    "end": "end of the recording.",
}
