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
from aero_viz.broadcast import Steerable
from aero_viz.clock import Clock
from aero_viz.config_history import ConfigHistory
from aero_viz.engine import Engine
from aero_viz.errors import UserError
from aero_viz.frame import Frame, Notice
from aero_viz.source import Source

__all__ = ["Frame", "Notice", "Session"]

_log = logging.getLogger(__name__)
_EXPECTED = (UserError, ValueError)
_CATCH_UP = 0.1
"""A flight that is late by up to this makes up for it by and by [s of wall time]: other work comes in bursts."""


class Session(Steerable):
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
        self._configs = ConfigHistory(config or PlannerConfig())
        super().__init__()
        self._engine = Engine(source, configs=self._configs, device=device, seed=seed, publish=self._frames.publish)
        self._clock = Clock()
        self._commands: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
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
                self.tick()

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

        return self._post(lambda: self._engine.set_goal(goal), quiet=quiet)

    def set_source(self, source: Source) -> Future[Any]:
        """Go on with another source from its start. If its first tick fails, the present one stays."""

        def command() -> None:
            self._engine.exchange(source)
            self._clock.restart(self._engine.next_time)

        return self._post(command)

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
        """Run `command` between two ticks; at once when no thread keeps the time."""
        future: Future[Any] = Future()

        def run() -> None:
            try:
                future.set_result(command())
            except Exception as error:
                future.set_exception(error)
                if not (quiet and isinstance(error, _EXPECTED)):
                    self._report(error)

        if self._thread is None or threading.current_thread() is self._thread:
            run()
        else:
            self._commands.put((run, future))
        return future

    def _report(self, error: Exception) -> None:
        self.notify(str(error) or type(error).__name__, level="error")
        _log.error("%s", error, exc_info=None if isinstance(error, _EXPECTED) else error)

    def _replan_if_changed(self) -> None:
        # Of many changes in a row only the last one is planned.
        if not self._playing and self.config is not self._engine.planned_config:
            self._engine.replan()

    # --- keeping time -----------------------------------------------------------------------------------------------

    def tick(self) -> Frame:
        """Advance the source by the last plan, observe, plan, publish. At the end the last frame is returned again."""
        frame = self._engine.tick()
        if self.source.outcome is not None:
            self._set_playing(False)
            if self._told_end != frame.epoch:
                self._told_end = frame.epoch
                words = [f"{self.source.name}: {_OUTCOMES.get(self.source.outcome, self.source.outcome)}"]
                self.notify(" ".join(words if frame.explanation is None else [*words, frame.explanation]))
        return frame

    def start(self, *, play: bool = True) -> None:
        """Start the thread that keeps time."""
        if self._thread is not None:
            raise RuntimeError("the session was already started.")
        self._thread = threading.Thread(target=self._run, args=(play,), name="aero-viz-session", daemon=True)
        self._thread.start()

    def _run(self, play: bool) -> None:
        if self._try_tick() and play and self.source.outcome is None:
            self._set_playing(True)
            self._clock.restart(self._engine.next_time)
        while True:
            delay = self._clock.delay_until(self._engine.next_time) if self._playing else None
            try:
                item = self._commands.get(timeout=delay)
            except queue.Empty:
                self._keep_up()
                self._try_tick()
                continue
            if item is None:
                return
            item[0]()

    def _try_tick(self) -> bool:
        try:
            self.tick()
        except Exception as error:
            self._set_playing(False)
            self._report(error)
            return False
        return True

    def _keep_up(self) -> None:
        """When planning takes too long, a recording skips ticks and a flight runs slower; both are counted."""
        late = self._clock.now() - self._engine.next_time
        if self.source.times is not None:
            self._engine.skip_to(self._clock.now())
        elif late > max(self.source.period, _CATCH_UP * self.speed):
            self._engine.dropped_ticks += int(late / self.source.period)
            self._clock.restart(self._engine.next_time)

    def close(self) -> None:
        """End the thread, the sinks, the source and the planner."""
        if self._thread is not None:
            self._commands.put(None)
            self._thread.join(timeout=10.0)
            self._thread = None
        # Who waits for a command that comes too late must not wait forever.
        while not self._commands.empty():
            if (item := self._commands.get()) is not None:
                item[1].cancel()
        self.close_sinks()
        self._engine.close()


_OUTCOMES = {
    "arrived": "arrived at the goal.",
    "collision": "collided with an obstacle.",
    "stall": "stalled: no progress toward the goal.",
    "out_of_bounds": "left the world.",
    "timeout": "ran out of time.",
    "end": "end of the recording.",
}
