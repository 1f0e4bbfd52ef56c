"""The session: an engine with a clock, sinks, and commands from any thread. Headless; knows nothing of the page."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.session.broadcast import Steerable
from aero_viz.session.clock import Clock
from aero_viz.session.config_history import ConfigHistory
from aero_viz.session.engine import Engine
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.source import Source

__all__ = ["Frame", "Notice", "Session"]

_log = logging.getLogger(__name__)
_EXPECTED = (UserError, ValueError)
_CATCH_UP = 0.1
"""A flight that is late by up to this makes up for it by and by [s of wall time]: other work comes in bursts."""


class Session(Steerable):
    """Owns a source, a planner and the clock.

    Either call `tick` yourself, as fast as you like, or `start` a thread that keeps time and control it from any thread
    with `play`, `pause`, `step`, `seek`, `speed` and the setters. Commands take effect between two ticks; those that
    come after `close` are cancelled.

    Args:
        source: where sweeps and states come from; closed with the session.
        config: of the planner.
        device: of the planner.
        seed: of the planner's noise.
    """

    def __init__(
        self, source: Source, *, config: PlannerConfig | None = None, device: str = "cpu", seed: int = 0
    ) -> None:
        self._configs = ConfigHistory(config or PlannerConfig())
        super().__init__()
        self._engine = Engine(source, configs=self._configs, device=device, seed=seed, publish=self._frames.publish)
        self._clock = Clock()
        self._commands: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closed = False
        # Who uses the engine holds it, until a thread is started that alone does.
        self._lock = threading.RLock()
        self._told_end: int | None = None

    # --- what anyone may read ---------------------------------------------------------------------------------------

    @property
    def frame(self) -> Frame | None:
        """The newest frame."""
        return self._engine.frame

    @property
    def source(self) -> Source:
        """The source in use; only read its attributes."""
        return self._engine.source

    @property
    def config(self) -> PlannerConfig:
        """The configuration that the next tick will use."""
        return self._configs.present[0]

    @property
    def speed(self) -> float:
        """Source time per wall time."""
        return self._clock.speed

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""
        return self._engine.time_range

    # --- commands, from any thread ----------------------------------------------------------------------------------

    def play(self) -> None:
        """Let time go on; at the end, start again from the beginning."""

        def command() -> None:
            if self.source.outcome is not None:
                self._engine.seek(self.time_range[0])
            self._set_playing(True)
            self._clock.restart(self._engine.next_time)

        self._post(command)

    def pause(self) -> None:
        """Hold time; parameters still act on the plan."""
        self._post(lambda: self._set_playing(False))

    def step(self, count: int = 1) -> Future[Any]:
        """Pause and go `count` ticks on, or back when negative."""

        def command() -> None:
            self._set_playing(False)
            if count < 0:
                self._engine.step_back(-count)
            for _ in range(count):
                self._tick()

        return self._post(command)

    def seek(self, time: float) -> Future[Any]:
        """Go to the tick at or before `time` [s]. A flight can go back to any tick flown, and from there on
        differently."""

        def command() -> None:
            self._engine.seek(time)
            self._clock.restart(self._engine.next_time)

        return self._post(command)

    def set_speed(self, speed: float) -> None:
        """Set source time per wall time; ValueError unless it lies in [0.01, 100]."""
        if not 0.01 <= speed <= 100.0:
            raise ValueError(f"speed is {speed:g}; it must be in [0.01, 100].")

        def command() -> None:
            self._clock.speed = float(speed)

        self._post(command)

    def set_goal(self, position: Any, *, quiet: bool = False) -> Future[Any]:
        """Move the goal [m], shape [3], world frame; one that can't be flown to is refused, and the goal stays.

        Args:
            position: where to.
            quiet: tell of a refusal in the future only, not in a notice: for one of many positions in a row.
        """
        goal = np.asarray(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"goal is {position!r}; it must be three finite numbers [m].")

        def command() -> None:
            self._engine.set_goal(goal)
            if self.source.outcome is None:
                self._told_end = None  # a flight that goes on ends once more

        return self._post(command, quiet=quiet)

    def set_source(self, source: Source) -> Future[Any]:
        """Go on with another source from its start. If its first tick fails, the present one stays.

        The session closes the source, also one that it does not take.
        """

        def command() -> None:
            self._engine.exchange(source)
            self._clock.restart(self._engine.next_time)

        future = self._post(command)
        future.add_done_callback(lambda done: source.close() if done.cancelled() else None)
        return future

    def set_samples(self, wanted: bool) -> Future[Any]:
        """Let frames carry the Stage I samples or not."""

        def command() -> None:
            self._engine.samples = wanted
            self._engine.replan()

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

    def _post(self, command: Callable[[], Any], *, quiet: bool = False) -> Future[Any]:
        """Run `command` between two ticks; where no thread keeps the time and no other ticks just now, at once."""
        future: Future[Any] = Future()

        def run() -> None:
            if self._closed:
                future.cancel()
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(command())
            except Exception as error:
                future.set_exception(error)
                if not (quiet and isinstance(error, _EXPECTED)):
                    self._report(error)

        self._commands.put(run)
        if self._closed:
            future.cancel()
        self._run_waiting()
        return future

    def _run_waiting(self) -> None:
        """Run the commands so far, where no thread of the session does. Who ticks just now runs them afterwards: to
        wait for the lock instead could take long, as a loop of ticks hardly lets go of it."""
        while self._thread is None and not self._commands.empty() and self._lock.acquire(blocking=False):
            try:
                while self._thread is None and not self._commands.empty():
                    if (command := self._commands.get()) is not None:
                        command()
            finally:
                self._lock.release()

    def _report(self, error: Exception) -> None:
        self.notify(str(error) or type(error).__name__, level="error")
        _log.error("%s", error, exc_info=None if isinstance(error, _EXPECTED) else error)

    def _replan_if_changed(self) -> None:
        # Of many changes in a row only the last one is planned.
        if not self._playing and self.config is not self._engine.planned_config:
            self._engine.replan()

    # --- keeping time -----------------------------------------------------------------------------------------------

    def tick(self) -> Frame:
        """Advance the source by the last plan, observe, plan, publish. At the end the last frame is returned again.

        Raises:
            RuntimeError: the session was started, so that its own thread ticks, or it is closed.
        """
        try:
            with self._lock:
                if self._closed:
                    raise RuntimeError("the session is closed; make another one.")
                if self._thread is not None:
                    raise RuntimeError("the session was started and ticks by itself; use step(), play() and pause().")
                self._run_waiting()
                return self._tick()
        finally:
            self._run_waiting()

    def _tick(self) -> Frame:
        frame = self._engine.tick()
        if self.source.outcome is not None:
            self._set_playing(False)
            if self._told_end != frame.epoch:
                self._told_end = frame.epoch
                words = [f"{self.source.name}: {_OUTCOMES.get(self.source.outcome, self.source.outcome)}"]
                self.notify(" ".join(words if frame.explanation is None else [*words, frame.explanation]))
        return frame

    def start(self, *, play: bool = True) -> None:
        """Start the thread that keeps time; RuntimeError when the session was started before or is closed."""
        with self._lock:
            if self._thread is not None or self._closed:
                raise RuntimeError(f"the session {'is closed' if self._closed else 'was already started'}.")
            self._thread = threading.Thread(target=self._run, args=(play,), name="aero-viz-session", daemon=True)
            self._thread.start()

    def _run(self, play: bool) -> None:
        if self._try_tick() and play and self.source.outcome is None:
            self._set_playing(True)
            self._clock.restart(self._engine.next_time)
        while True:
            delay = self._clock.delay_until(self._engine.next_time) if self._playing else None
            try:
                command = self._commands.get(timeout=delay)
            except queue.Empty:
                self._keep_up()
                self._try_tick()
                continue
            if command is None:
                return
            command()

    def _try_tick(self) -> bool:
        try:
            self._tick()
        except Exception as error:
            self._set_playing(False)
            self._report(error)
            return False
        return True

    def _keep_up(self) -> None:
        """When planning takes too long, a recording skips ticks and a flight runs slower."""
        late = self._clock.now() - self._engine.next_time
        if self.source.times is not None:
            self._engine.skip_to(self._clock.now())
        elif late > max(self.source.period, _CATCH_UP * self.speed):
            self._clock.restart(self._engine.next_time)

    def close(self) -> None:
        """End the thread, the sinks, the source and the planner."""
        with self._lock:
            self._closed = True
        self._run_waiting()
        if self._thread is not None:
            self._commands.put(None)
            self._thread.join(timeout=10.0)
        self.close_sinks()
        if self._thread is None or not self._thread.is_alive():
            self._engine.close()  # never under a thread that is still planning with it


_OUTCOMES = {
    "arrived": "arrived at the goal.",
    "collision": "collided with an obstacle.",
    "stall": "stalled: no progress toward the goal.",
    "out_of_bounds": "left the world.",
    "timeout": "ran out of time.",
    "end": "end of the recording.",
}
