"""The loop source -> planner -> Frame, and jumps in time. Single-threaded; `Session` adds threads."""

from __future__ import annotations

import dataclasses
import gc
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import DroneConfig
from aero_viz.errors import UserError
from aero_viz.planners.plan import Plan
from aero_viz.planners.planner import Planner, PlannerError
from aero_viz.planners.registry import make
from aero_viz.session.config_history import ConfigHistory
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source
from aero_viz.session.timeline import Checkpoint, Timeline

_WARM_UP = 100
"""Ticks of a recording that are planned before one that is sought, so that the planner knows what went before."""
PLANNER_FAILED = "planner_failed"
"""Outcome of a flight whose planner has failed; `Frame.explanation` says how."""


class Engine:
    """Owns a source, a planner and a checkpoint of every tick so far.

    Args:
        source: provides sweeps and states; closed with the engine.
        configs: provides the configuration of every tick.
        device: Warp device of the planner.
        seed: seed of the planner's noise.
        publish: called with every frame.
    """

    def __init__(
        self, source: Source, *, configs: ConfigHistory, device: str, seed: int, publish: Callable[[Frame], None]
    ) -> None:
        self.source = source
        """The source in use."""
        self.frame: Frame | None = None
        """The newest frame."""
        self.samples = False
        """True if frames include the Stage I samples."""
        self.judges = False
        """True if frames say of every candidate whether it is safe, which is asked of the planner after each plan."""
        self.dropped_ticks = 0
        """Ticks of a recording that were skipped since its start."""
        self._configs = configs
        self._base = self._config = configs.current[0]
        """Configuration of the session and that of the leg at the newest plan."""
        self._planner = make(self._config, device=device, seed=seed)
        self._device = device
        self.seed = seed
        """Seed of the planner's noise."""
        self._publish_frame = publish
        self._timeline = self._new_timeline()
        self._tick_ends: deque[float] = deque(maxlen=200)
        self._epoch = 0
        self._is_gapless = True
        """True if the ticks of the timeline follow one another, and were planned as the next one will be."""

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""
        times = self.source.info.times
        return (float(times[0]), float(times[-1])) if times is not None and len(times) else self._timeline.time_range

    @property
    def planned_config(self) -> DroneConfig:
        """Configuration of the session at the newest plan."""
        return self._base

    @property
    def next_time(self) -> float:
        """Source time of the next tick [s]."""
        if self.frame is None:
            return 0.0
        times = self.source.info.times
        if times is None:
            return self.frame.time + self.source.info.period
        return float(times[min(_row(times, self.frame.time) + 1, len(times) - 1)])

    def tick(self) -> Frame:
        """Advance the source by the last plan, then observe, plan and publish.

        Returns the last frame again if the source has ended.
        """
        if self.frame is None or not self._timeline:
            return self._plan()
        if self.frame.outcome is not None:
            return self.frame
        started = time.perf_counter()
        self.source.advance(self.frame.plan)
        advance_ms = 1e3 * (time.perf_counter() - started)
        if self.source.outcome == "end":
            # A recording has no tick after its last one: keep the last plan.
            return self._publish(dataclasses.replace(self.frame, outcome="end", explanation=self.source.explanation))
        return self._plan(advance_ms=advance_ms)

    def replan(self) -> None:
        """Plan the current tick again, from the planner's state before its first plan."""
        self._leave_failure()
        if self._timeline:
            self._plan(again=self._timeline.current)

    def flown(self) -> list[tuple[Checkpoint, DroneConfig]]:
        """Return every tick that can be returned to, with the configuration of its last plan."""
        return self._timeline.flown()

    def repeat(self, checkpoint: Checkpoint) -> Frame:
        """Plan a tick of an equal source again, and continue from there."""
        self.source.restore(checkpoint.source)
        self._timeline.append(checkpoint, self.source.observe().actual_state.position)
        return self._plan(again=checkpoint)

    def alter(self, change: Callable[[Source], object]) -> None:
        """Change the source, such as its goal or its obstacles, and plan the current tick again.

        The change belongs to the current tick and those that follow: a return to an earlier one is without it. If the
        change or planning fails, the source is as it was.
        """
        self._leave_failure()
        before = self.source.checkpoint()
        try:
            change(self.source)
            if self._timeline:
                self._timeline.amend(self.source.checkpoint())
                self._is_gapless = False
            self.replan()
        except Exception:
            # Otherwise every later tick would fail in the same way.
            self.source.restore(before)
            if self._timeline:
                self._timeline.amend(before)
            raise

    def _leave_failure(self) -> None:
        """Return the source to the tick of the last plan if the planner failed at the one after it."""
        if self.frame is not None and self.frame.outcome == PLANNER_FAILED and self._timeline:
            self.source.restore(self._timeline.current.source)

    def seek(self, time: float) -> None:
        """Go to the tick at or before `time` [s]."""
        if (times := self.source.info.times) is not None:
            self._go_to_row(times, max(_row(times, time), 0))
        elif self._timeline:
            self._return_to(self._timeline.go_to_time(time))

    def step_back(self, count: int) -> None:
        """Go back by `count` ticks, or to the first one."""
        times = self.source.info.times
        if times is not None and self.frame is not None:
            self._go_to_row(times, max(_row(times, self.frame.time) - count, 0))
        elif self._timeline:
            self._return_to(self._timeline.go_by(-count))

    def _go_to_row(self, times: NDArray[np.float64], row: int) -> None:
        """Plan a tick of a recording after the ticks before it, whatever was shown so far.

        Otherwise its plan would depend on how one came there. The ticks before it are those since the beginning, and
        far from there at least the last `_WARM_UP`.
        """
        start = max(row - _WARM_UP, 0)
        first, last = self._planned_rows(times)
        if self._is_gapless and self._configs.current[0] is self._base and first <= start <= last:
            begin = min(row, last)
            checkpoint: Checkpoint | None = self._timeline.go_by(begin - first - self._timeline.earlier)
            self.source.restore(checkpoint.source)
            self._epoch += 1
        else:
            begin, checkpoint = start, None
            self.source.seek(float(times[start]))
            self._start_over()
        self._plan(again=checkpoint, is_shown=begin == row)
        for reached in range(begin + 1, row + 1):
            assert self.frame is not None
            self.source.advance(self.frame.plan)
            if self._plan(is_shown=reached == row).outcome == PLANNER_FAILED:
                return

    def _planned_rows(self, times: NDArray[np.float64]) -> tuple[int, int]:
        """Return the rows of the first and the last tick of the timeline of a recording, -1 if it is empty."""
        if not self._timeline:
            return -1, -1
        first, last = self._timeline.time_range
        return _row(times, first), _row(times, last)

    def skip_to(self, time: float) -> None:
        """Drop ticks of a recording so that the next tick is the one at or before `time` [s]."""
        times = self.source.info.times
        if times is None or self.frame is None or self.source.outcome is not None:
            return
        target = _row(times, time)
        skipped = target - _row(times, self.frame.time) - 1
        if skipped > 0:
            self.source.seek(float(times[target - 1]))
            self.dropped_ticks += skipped
            self._is_gapless = False

    def set_source(self, source: Source, *, seed: int | None = None) -> None:
        """Continue with another source, from its start, and with another seed of the planner's noise if one is given.

        If its first tick fails, the new source is closed and the current one stays.
        """
        before = (self.source, self._timeline, self._planner.history(), self.dropped_ticks, self.seed)
        self.source, self.dropped_ticks, self.seed = source, 0, self.seed if seed is None else seed
        self._start_over()
        try:
            self._plan()
        except Exception:
            self.source, self._timeline, history, self.dropped_ticks, self.seed = before
            self._planner.reset(seed=self.seed)
            self._planner.restore(history)
            source.close()
            raise
        before[0].close()
        del before
        gc.collect()  # a source refers to itself; without this, several of some 50 MB each wait for the collector

    def _start_over(self) -> None:
        """Discard all checkpoints and the previous plan; the source's current tick becomes the first one."""
        self._planner.reset(seed=self.seed)
        self._timeline, self._is_gapless = self._new_timeline(), True
        self._epoch += 1

    def _new_timeline(self) -> Timeline:
        kept = self.source.info.kept
        return Timeline() if kept is None else Timeline(kept)

    def _return_to(self, checkpoint: Checkpoint) -> None:
        self.source.restore(checkpoint.source)
        self._epoch += 1
        self._plan(again=checkpoint)

    def _plan(self, *, again: Checkpoint | None = None, advance_ms: float = 0.0, is_shown: bool = True) -> Frame:
        """Plan the source's current tick, and publish it.

        Args:
            again: checkpoint of a tick that is planned again; None for a new tick.
            advance_ms: how long the source took to advance to this tick [ms].
            is_shown: False for a tick on the way to another one, which is not published.
        """
        base, version = self._configs.current
        started = time.perf_counter()
        observation = self.source.observe()
        config = observation.leg_config(base)
        observation = observation.remembered(config)
        observed = time.perf_counter()
        if config is not self._config:
            self._configure(config, base)
        if base is not self._base:
            self._base = base
            self._is_gapless = self._is_gapless and not self._timeline
        if again is None:
            history = self._planner.history()
        else:
            # Only after `_configure`: the history fits a planner of the same structure.
            history = again.planner
            self._planner.restore(history)
        self._planner.samples = self.samples
        try:
            plan = self._planner.attempt(observation)
        except PlannerError as error:
            if again is not None or self.frame is None or not self._timeline:
                raise UserError(str(error)) from error
            # The flight ends at its last plan, with the reason.
            return self._publish(dataclasses.replace(self.frame, outcome=PLANNER_FAILED, explanation=str(error)))
        planned = time.perf_counter()
        is_safe = self.judge(self._planner, plan)
        if again is None:
            checkpoint = Checkpoint(observation.time, self.source.checkpoint(), history)
            self._timeline.append(checkpoint, observation.actual_state.position)
            self._tick_ends.append(planned)
        if self._timeline:
            self._timeline.planned_with(base)
        times = self.source.info.times
        frame = Frame(
            index=self._timeline.index if times is None else _row(times, observation.time),
            time=observation.time,
            observation=observation,
            plan=plan,
            config=config,
            base_config=base,
            config_version=version,
            outcome=self.source.outcome,
            explanation=self.source.explanation,
            timings_ms={
                "observe": 1e3 * (observed - started),
                "plan": plan.stage_ms.get("total", 1e3 * (planned - observed)),
                "advance": advance_ms,
            },
            rate=self._rate(),
            dropped_ticks=self.dropped_ticks,
            trail=self._timeline.trail(),
            epoch=self._epoch,
            source=self.source.info,
            checkpoint=self._timeline.current,
            seed=self.seed,
            device=self._planner.device,
            is_safe=is_safe,
        )
        if not is_shown:
            self.frame = frame
            return frame
        return self._publish(frame)

    def judge(self, planner: Planner, plan: Plan) -> NDArray[np.bool_] | None:
        """Return which candidates of a planner's last plan are safe, shape [M]; None if nobody wants to know."""
        return planner.judge(plan) if self.judges else None

    def _publish(self, frame: Frame) -> Frame:
        self.frame = frame
        self._publish_frame(frame)
        return frame

    def _configure(self, config: DroneConfig, base: DroneConfig) -> None:
        try:
            self._planner = reconfigured(self._planner, config, device=self._device, seed=self.seed)
        except Exception:
            # Otherwise every later tick would fail in the same way, and undo would return to it.
            self._configs.drop(base, self._base)
            raise
        self._config = config

    def _rate(self) -> float:
        if not self._tick_ends:
            return 0.0
        now = self._tick_ends[-1]
        recent = [end for end in self._tick_ends if now - end <= 1.0]
        return (len(recent) - 1) / (now - recent[0]) if len(recent) > 1 and now > recent[0] else 0.0

    def interrupt(self) -> None:
        """End a plan that waits for something, from any thread; the engine is closed afterwards."""
        self._planner.interrupt()

    def close(self) -> None:
        """Release the source and the planner."""
        self.source.close()
        self._planner.close()


def reconfigured(planner: Planner, config: DroneConfig, *, device: str, seed: int) -> Planner:
    """Return a planner with another configuration: the same one, unless the configuration is for another planner."""
    if config.planner == planner.config.planner:
        planner.configure(config)
        return planner
    other = make(config, device=device, seed=seed)
    planner.close()
    return other


def _row(times: NDArray[np.float64], time: float) -> int:
    """Return the row of a recording's last tick at or before `time` [s], -1 before the first."""
    return int(np.searchsorted(times, time + 1e-9, side="right")) - 1
