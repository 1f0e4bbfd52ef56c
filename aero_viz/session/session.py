"""The session: an engine with a clock, sinks, and commands from any thread. Headless."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from aero_planner.config import DroneConfig, PlannerConfig
from aero_viz.session.base import BaseSession, SessionControls
from aero_viz.session.clock import Clock
from aero_viz.session.command_loop import USER_MISTAKES, CommandLoop
from aero_viz.session.comparison import Comparison
from aero_viz.session.config_history import ConfigHistory
from aero_viz.session.engine import PLANNER_FAILED, Engine
from aero_viz.session.frame import Frame, end_sentence
from aero_viz.session.source import Source, SourceInfo
from aero_viz.session.timeline import Checkpoint
from aero_viz.session.world_history import WorldHistory

if TYPE_CHECKING:
    from aero_viz.scenes import World

_log = logging.getLogger(__name__)
_CATCH_UP = 0.1
"""Delay up to which a flight catches up with the clock [s of wall time], since other processes run in bursts."""


class Session(BaseSession):
    """Owns a source, a planner and the clock.

    Either call `tick` in a loop, as fast as the machine can, or call `start`, which ticks on a separate thread in step
    with the clock. All other methods may be called from any thread. They take effect between two ticks; after `close`
    they are cancelled.

    Args:
        source: provides sweeps and states; closed with the session.
        config: configuration, which also says which planner it is for; None is the default of AERO-MPPI.
        device: Warp device of the planner.
        seed: seed of the planner's noise.
    """

    _engine_type: type[Engine] = Engine

    def __init__(
        self, source: Source, *, config: DroneConfig | None = None, device: str = "cpu", seed: int = 0
    ) -> None:
        self._configs = ConfigHistory(config or PlannerConfig())
        super().__init__()
        self._engine = self._engine_type(
            source, configs=self._configs, device=device, seed=seed, publish=self._frames.publish
        )
        self.device = device
        self.comparison = Comparison(self._engine, device=device, config=lambda: self.config)
        """State of the comparison with a pinned configuration, A."""
        self._worlds = WorldHistory()
        self._clock = Clock()
        # Only commands, ticks and `_work` use the engine, one at a time.
        self._loop = CommandLoop(
            report=self._report, work=self._work, idle_time=self._idle_time, has_work=self._must_compare
        )
        self._samples = False
        """True if frames must include samples."""
        self._announced_epoch: int | None = None
        """Epoch of the last frame whose outcome was announced."""

    @property
    def controls(self) -> SessionControls:
        """The session itself: it takes every command."""
        return self

    @property
    def frame(self) -> Frame | None:
        return self._engine.frame

    @property
    def seed(self) -> int:
        """Seed of the planner's noise."""
        return self._engine.seed

    @property
    def source(self) -> SourceInfo:
        """Facts about the source in use."""
        return self._engine.source.info

    @property
    def config(self) -> DroneConfig:
        """Configuration of the next tick."""
        return self._configs.current[0]

    @property
    def speed(self) -> float:
        return self._clock.speed

    @property
    def time_range(self) -> tuple[float, float]:
        return self._engine.time_range

    # --- commands ---------------------------------------------------------------------------------------------------

    def play(self) -> None:
        """Resume playback, from the beginning if the source has ended."""

        def command() -> None:
            if self._engine.source.outcome is not None:
                self._engine.seek(self.time_range[0])
            elif self.frame is not None and self.frame.outcome == PLANNER_FAILED:
                self._engine.seek(self.frame.time)  # it may go well now
            self._set_playing(True)
            self._clock.restart(self._engine.next_time)

        self._post(command)

    def pause(self) -> None:
        """Stop time at the current tick. Parameters still change its plan."""
        self._post(lambda: self._set_playing(False))

    def step(self, count: int = 1) -> Future[Any]:
        """Pause and move by `count` ticks, backward if negative."""

        def command() -> None:
            self._set_playing(False)
            if count < 0:
                self._engine.step_back(-count)
            for _ in range(count):
                self._tick()

        return self._post(command)

    def seek(self, time: float) -> Future[Any]:
        """Go to the tick at or before `time` [s].

        A flight can return to any tick flown so far, and continue differently from there.

        Raises:
            ValueError: the time is not a finite number.
        """
        if not np.isfinite(time):
            raise ValueError(f"time is {time}; it must be a finite number [s].")

        def command() -> None:
            self._engine.seek(time)
            self._clock.restart(self._engine.next_time)

        return self._post(command)

    def set_speed(self, speed: float) -> None:
        """Set the source time that passes per wall time; ValueError unless it is in [0.01, 100]."""
        if not 0.01 <= speed <= 100.0:
            raise ValueError(f"speed is {speed:g}; it must be in [0.01, 100].")

        def command() -> None:
            self._clock.speed = float(speed)

        self._post(command)

    def set_goal(self, position: ArrayLike, *, quiet: bool = False) -> Future[Any]:
        """Move the goal. The source refuses a position that cannot be flown to; the goal then stays.

        Args:
            position: new goal [m], shape [3], world frame.
            quiet: report a refusal in the future only, without a notice; for one of many positions in a row.

        Raises:
            ValueError: the position is not three finite numbers. A refusal by the source is in the future, and logged.
        """
        goal = np.asarray(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"goal is {position!r}; it must be three finite numbers [m].")

        return self.alter(lambda source: source.set_goal(goal), quiet=quiet)

    def alter(self, change: Callable[[Any], object], *, quiet: bool = False, step: object = None) -> Future[Any]:
        """Change the source between two ticks, such as its obstacles or its wind, and plan the current tick again.

        The change belongs to the current tick and those that follow: after going back to an earlier one, it is undone.

        Args:
            change: called with the source on the session's thread; what it raises leaves the source as it was.
            quiet: report a refusal in the future only.
            step: changes of the world in a row with the same `step` are undone together, such as those of a drag.
        """

        def command() -> None:
            before = self._world
            self._alter(change)
            self._worlds.note(before, self._world, step=step)

        return self._post(command, quiet=quiet)

    def _alter(self, change: Callable[[Any], object]) -> None:
        self._engine.alter(change)
        if self._engine.source.outcome is None:
            self._announced_epoch = None  # the flight continues and will end once more

    def set_source(
        self,
        source: Source,
        *,
        seed: int | None = None,
        convert: Callable[[DroneConfig], DroneConfig] | None = None,
    ) -> Future[Any]:
        """Continue with another source, from its start. If its first tick fails, the current source stays.

        The session closes `source` in either case.

        Args:
            source: the other source.
            seed: seed of the planner's noise from now on; None leaves it.
            convert: replaces all configurations before the first tick: the current one, those of undo and redo, and A.
                This cannot be undone. A configuration for which it raises ValueError stays.
        """

        def command() -> None:
            with self._configs.converted(convert or (lambda config: config)):
                self._engine.set_source(source, seed=seed)
            if convert is not None:
                self.comparison.convert(convert)
            self._worlds = WorldHistory()  # nothing of the one before can be undone, and meshes are large
            self._clock.restart(self._engine.next_time)

        future = self._post(command)
        future.add_done_callback(lambda done: source.close() if done.cancelled() else None)
        return future

    def set_samples(self, enabled: bool) -> Future[Any]:
        """Include the Stage I samples in frames, or leave them out. Of several calls in a row, the last one wins."""
        self._samples = enabled

        def command() -> None:
            if self._engine.samples != self._samples:
                self._engine.samples = self._samples
                self._engine.replan()

        return self._post(command)

    def judge_candidates(self) -> Future[Any]:
        """Say in every frame from now on which candidates are safe, also those that the planner's choice skipped."""

        def command() -> None:
            if not self._engine.judges:
                self._engine.judges = True
                self._engine.replan()

        return self._post(command)

    def catch_up(self) -> Future[Any]:
        return self._post(lambda: None)

    def flown(self) -> Future[list[tuple[Checkpoint, DroneConfig]]]:
        """Return every tick of the source so far, with the configuration of its last plan; see `repeat`."""
        return self._post(self._engine.flown)

    def configure(self, change: DroneConfig | Mapping[str, Any]) -> DroneConfig:
        """Use another configuration, or change some parameters of the current one, from the next tick on.

        Raises:
            ValueError: a parameter is unknown or out of its bounds; the current configuration stays.
        """
        config = self._configs.change(change)
        self._post(self._replan_if_changed)
        return config

    def undo(self) -> DroneConfig:
        """Take back the newest change of the configuration, or of the world at this tick; return the configuration."""
        if self._worlds.changed_at(self._world) <= self._configs.changed_at:
            return self._go_to_config(-1)
        self._post(lambda: self._alter(self._worlds.undo))
        return self.config

    def redo(self) -> DroneConfig:
        """Redo the change that was undone last, and return the configuration."""
        if self._worlds.undone_at(self._world) <= self._configs.undone_at:
            return self._go_to_config(+1)
        self._post(lambda: self._alter(self._worlds.redo))
        return self.config

    @property
    def _world(self) -> World | None:
        return None if self.frame is None else self.frame.moving_world

    def _go_to_config(self, step: int) -> DroneConfig:
        config = self._configs.go(step)
        self._post(self._replan_if_changed)
        return config

    def pin(self) -> Future[Any]:
        """Pause, and make the present configuration A, with which every later configuration, B, is compared."""

        def command() -> None:
            self._stop_to_compare()
            self.comparison.pin()

        return self._post(command)

    def _stop_to_compare(self) -> None:
        self._set_playing(False)

    def unpin(self) -> Future[Any]:
        """End the comparison."""
        return self._post(self.comparison.unpin)

    def compare_with(self, config: DroneConfig) -> Future[Any]:
        """Use `config` as B against the pinned configuration, A; without one, the present one is pinned first."""

        def command() -> None:
            self._stop_to_compare()
            if self.comparison.pinned is None:
                self.comparison.pin()
            self._configs.change(config)
            self._replan_if_changed()

        return self._post(command)

    def fly_both(self) -> Future[Any]:
        """Pause, let A fly from the present tick to its end, and then play B from there.

        The future is done when A departs; it has a UserError if nothing is pinned or the session is at its end.
        """

        def command() -> None:
            self._set_playing(False)
            self.comparison.depart(when_over=self.play)

        return self._post(command)

    def _post(self, command: Callable[[], Any], *, quiet: bool = False) -> Future[Any]:
        """Run `command` between two ticks: immediately if the session has no thread and nobody is ticking it."""
        return self._loop.put(command, quiet=quiet)

    def _report(self, error: Exception) -> None:
        self.notify(str(error) or type(error).__name__, level="error")
        _log.error("%s", error, exc_info=None if isinstance(error, USER_MISTAKES) else error)

    def _replan_if_changed(self) -> None:
        # After many changes in a row, only the last one is planned.
        if not self._playing and self.config is not self._engine.planned_config:
            self._engine.replan()

    # --- ticks ------------------------------------------------------------------------------------------------------

    def tick(self) -> Frame:
        """Advance the source by the last plan, then observe, plan and publish.

        Returns the last frame again if the source has ended.

        Raises:
            RuntimeError: the session was started, so that its own thread ticks, or it is closed.
        """
        with self._loop.exclusive():
            return self._tick()

    def _tick(self) -> Frame:
        frame = self._engine.tick()
        outcome = self._engine.source.outcome or frame.outcome
        if outcome is not None:
            self._set_playing(False)
            if self._announced_epoch != frame.epoch:
                self._announced_epoch = frame.epoch
                text = end_sentence(self.source.name, outcome, frame.explanation)
                self.notify(text, level="info" if outcome in ("arrived", "end") else "failure")
        return frame

    def start(self, *, play: bool = True) -> None:
        """Start the thread that ticks in step with the clock.

        Raises:
            RuntimeError: the session was started before, or it is closed.
        """

        def first() -> None:
            if self._try_tick() and play and self._engine.source.outcome is None:
                self._set_playing(True)
                self._clock.restart(self._engine.next_time)

        self._loop.start(first, name="aero-viz-session")

    def _idle_time(self) -> float | None:
        """Return the time until there is work besides commands [s]; None if there is none."""
        if self._playing:
            return self._clock.delay_until(self._engine.next_time)
        return 0.0 if self._must_compare() else None

    def _must_compare(self) -> bool:
        return self.comparison.has_work and not self._playing

    def _work(self) -> None:
        """Tick if time advances; otherwise work on the comparison, which ends if it fails."""
        if self._playing:
            self._keep_up()
            self._try_tick()
        else:
            self._work_on_comparison()

    def _work_on_comparison(self) -> None:
        try:
            self.comparison.work()
        except Exception as error:
            self.comparison.unpin()
            self._report(error)

    def _try_tick(self) -> bool:
        try:
            self._tick()
        except Exception as error:
            self._set_playing(False)
            self._report(error)
            return False
        return True

    def _keep_up(self) -> None:
        """Handle planning that takes too long: a recording skips ticks, a flight runs slower."""
        delay = self._clock.now() - self._engine.next_time
        if self.source.times is not None:
            self._engine.skip_to(self._clock.now())
        elif delay > max(self.source.period, _CATCH_UP * self.speed):
            self._clock.restart(self._engine.next_time)

    def close(self) -> None:
        """Stop the thread and close the sinks, the source and the planner."""
        self._engine.interrupt()
        has_ended = self._loop.close()
        self.close_sinks()
        if has_ended:  # never while a thread still plans with it
            self.comparison.close()
            self._engine.close()
