"""A second configuration that plans the session's tick and flies on from it while the session is paused."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import weakref
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.errors import UserError
from aero_viz.planners.planner import Planner
from aero_viz.planners.registry import make
from aero_viz.session.engine import Engine, reconfigured
from aero_viz.session.frame import Frame
from aero_viz.session.publisher import Publisher
from aero_viz.session.timeline import Checkpoint

_TICKS_PER_TURN = 4
"""Ticks that A flies before the session runs commands again."""
_TICKS_MAX = 30_000
"""Longest flight of A [ticks]: ten minutes at 50 Hz."""


class ComparisonEvent(NamedTuple):
    """A step of the comparison."""

    kind: Literal["pinned", "planned", "departed", "flown", "unpinned"]
    """"planned": A planned the session's tick; "departed": A begins to fly from it; "flown": A has flown a tick."""
    config: DroneConfig | None
    """Configuration A; None after "unpinned"."""
    frame: Frame | None = None
    """A's frame, for "planned" and "flown"."""


@dataclasses.dataclass
class _Flight:
    """Flight of A, between two of its turns."""

    checkpoint: object
    """Checkpoint of the source."""
    history: Any
    """State of the planner before its next plan."""
    ticks: int = 0


class Comparison:
    """Plans and flies with a pinned configuration, A, for comparison with the session's own, B.

    While the session is paused, A plans its tick from the same state, cloud, history and seed; on request it flies on
    from there to the end, with the same noise. All of it happens on the session's thread between two commands, so a
    playing session never waits for A. The planner of A is built when A plans for the first time, and kept. Methods are
    called on the session's thread; attributes may be read from any thread.

    Args:
        engine: provides the ticks.
        device: Warp device of the planner.
        config: returns configuration B.
    """

    def __init__(self, engine: Engine, *, device: str, config: Callable[[], DroneConfig]) -> None:
        self.pinned: DroneConfig | None = None
        """Configuration A; None while nothing is compared."""
        self.frame: Frame | None = None
        """A's plan of the session's tick; None until there is one."""
        self._engine, self._device, self._config = engine, device, config
        self._planner: Planner | None = None
        self._planned: tuple[Checkpoint, DroneConfig] | None = None
        self._flight: _Flight | None = None
        self._source = weakref.ref(engine.source)
        self._when_over: Callable[[], None] | None = None
        self._events = Publisher[ComparisonEvent]()

    def subscribe(self, callback: Callable[[ComparisonEvent], None], *, name: str) -> Mailbox[ComparisonEvent]:
        """Call `callback` with every event, on a separate thread, until `unsubscribe`."""
        return self._events.subscribe(callback, capacity=_TICKS_MAX, name=name)

    def unsubscribe(self, sink: Mailbox[ComparisonEvent]) -> None:
        """Remove and close a sink."""
        self._events.unsubscribe(sink)

    def pin(self, config: DroneConfig | None = None) -> None:
        """Make `config`, or the present configuration of the session, A."""
        self._clear()
        self.pinned = config or self._config()
        self._events.publish(ComparisonEvent("pinned", self.pinned))

    def convert(self, function: Callable[[DroneConfig], DroneConfig]) -> None:
        """Replace A by the result of `function`. A stays where that raises ValueError."""
        if self.pinned is None:
            return
        with contextlib.suppress(ValueError):
            config = function(self.pinned)
            if config != self.pinned:
                self.pin(config)

    def unpin(self) -> None:
        """End the comparison."""
        self._clear()
        self.pinned = None
        self._events.publish(ComparisonEvent("unpinned", None))

    def depart(self, *, when_over: Callable[[], None] | None = None) -> None:
        """Let A fly from the session's tick to its end while the session is paused.

        Args:
            when_over: called when it has arrived there.

        Raises:
            UserError: nothing is compared, or the session is at its end.
        """
        frame = self._engine.frame
        if self.pinned is None or frame is None or frame.checkpoint is None:
            raise UserError("Pin a configuration to compare with first.")
        if self._engine.source.outcome is not None:
            raise UserError("The end is reached at this tick. Go back to an earlier one, and compare from there.")
        self._follow_source()
        self._flight = _Flight(frame.checkpoint.source, frame.checkpoint.planner)
        self._when_over = when_over
        self._events.publish(ComparisonEvent("departed", self.pinned))

    @property
    def has_work(self) -> bool:
        """True if A has not planned the session's tick, or is flying."""
        return self.pinned is not None and (self._must_plan or self._flight is not None)

    @property
    def is_flying(self) -> bool:
        """True while the flight of A is not complete."""
        return self._flight is not None

    def work(self) -> None:
        """Plan the session's tick with A, or fly A for a few ticks."""
        self._follow_source()
        if self.pinned is None:
            return
        if self._must_plan:
            self._plan_tick()
        elif self._flight is not None:
            self._fly(self._flight)

    def close(self) -> None:
        """Release the planner."""
        self._clear()
        self.pinned = None
        self._events.close()
        if self._planner is not None:
            self._planner.close()
            self._planner = None

    @property
    def _must_plan(self) -> bool:
        frame = self._engine.frame
        if frame is None or frame.checkpoint is None:
            return False
        planned = self._planned
        return planned is None or planned[0] is not frame.checkpoint or planned[1] is not self.pinned

    def _follow_source(self) -> None:
        """Drop the plan and the flight of another source."""
        if self._engine.source is not self._source():
            self._source, self._flight, self.frame = weakref.ref(self._engine.source), None, None
            if self._planner is not None:
                self._planner.reset(seed=self._engine.seed)

    def _clear(self) -> None:
        self.frame, self._planned, self._flight, self._when_over = None, None, None, None

    def _plan_tick(self) -> None:
        frame, config = self._engine.frame, self.pinned
        assert frame is not None and frame.checkpoint is not None and config is not None
        self._planned = (frame.checkpoint, config)  # before planning: a plan that fails is not tried again
        self.frame = self._plan(frame, frame.checkpoint.planner)
        self._events.publish(ComparisonEvent("planned", config, self.frame))

    def _plan(self, frame: Frame, history: Any) -> Frame:
        """Return `frame` with the plan of A from its observation."""
        assert self.pinned is not None
        config = frame.observation.leg_config(self.pinned)
        if self._planner is None:
            self._planner = make(config, device=self._device, seed=self._engine.seed)
        elif self._planner.config is not config:
            self._planner = reconfigured(self._planner, config, device=self._device, seed=self._engine.seed)
        self._planner.restore(history)
        started = time.perf_counter()
        plan = self._planner.attempt(frame.observation)
        elapsed = 1e3 * (time.perf_counter() - started)
        timings = {**frame.timings_ms, "plan": plan.stage_ms.get("total", elapsed)}
        is_safe = self._engine.judge(self._planner, plan)
        return dataclasses.replace(frame, plan=plan, config=self.pinned, timings_ms=timings, is_safe=is_safe)

    def _fly(self, flight: _Flight) -> None:
        """Fly A for a few ticks with the session's source, which then returns to where it was."""
        source, shown = self._engine.source, self._engine.frame
        assert shown is not None and self.pinned is not None
        before = source.checkpoint()
        try:
            source.restore(flight.checkpoint)
            for _ in range(_TICKS_PER_TURN):
                observation = source.observe()
                observation = observation.remembered(observation.leg_config(self.pinned))
                frame = dataclasses.replace(
                    shown, time=observation.time, observation=observation, outcome=source.outcome,
                    explanation=source.explanation,
                )  # fmt: skip
                frame = self._plan(frame, flight.history)
                assert self._planner is not None
                flight.history, flight.ticks = self._planner.history(), flight.ticks + 1
                if frame.outcome is None:
                    source.advance(frame.plan)
                    if source.outcome == "end":  # a recording has no tick after its last one
                        frame = dataclasses.replace(frame, outcome="end")
                self._events.publish(ComparisonEvent("flown", self.pinned, frame))
                if frame.outcome is not None or flight.ticks >= _TICKS_MAX:
                    self._flight = None
                    break
            flight.checkpoint = source.checkpoint()
        except Exception:
            self._flight = None
            raise
        finally:
            source.restore(before)
        if self._flight is None and self._when_over is not None:
            self._when_over()
