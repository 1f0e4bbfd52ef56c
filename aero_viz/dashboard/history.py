"""Figures and events of every tick of a source, and of the future that was left when the flight forked."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig, PlanStatus
from aero_viz.session.frame import Frame

__all__ = ["CLEARANCE_MAX", "COLUMNS", "Event", "FlightHistory", "Past", "effective_samples", "true_clearance"]

CLEARANCE_MAX = 5.0
"""Largest clearance that is told apart [m]."""
COLUMNS = (
    "time", "speed", "clearance", "cost", "goal_cost", "collision_cost", "plan_ms", "safe", "samples", "x", "y", "z",
)  # fmt: skip
"""Columns of the rows: [s], [m/s], [m], S2 of the chosen instance and two of its terms, [ms], number of safe
candidates, effective number of samples of the chosen instance, position [m]."""
_SOLIDS_MAX = 3000
"""Number of solids up to which the exact clearance is computed at every tick; more take too long."""
_SAME = 1e-4
"""Distance up to which two positions are the same [m]."""

Rows = NDArray[np.float64]


class Event(NamedTuple):
    """Something that happened at a tick."""

    time: float
    """Source time [s]."""
    kind: str
    """"braking", "end", "parameters" or "goal"."""
    text: str


@dataclass(frozen=True, eq=False)
class Past:
    """State of a history at one moment. Arrays are read-only."""

    rows: Rows
    """One row for each tick so far, in the order of time, with the columns `COLUMNS`."""
    events: tuple[Event, ...]
    ghost: Rows
    """Rows of the future that was left when the flight last forked; empty if it never did."""
    ghost_outcome: str | None
    """Outcome of that future; None if it was left while running."""
    differs_at: float | None
    """First time at which the flight differs from that future [s]; None as long as it does not."""


class FlightHistory:
    """Keeps a row for every tick. Safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._clear()

    def add(self, frame: Frame) -> None:
        """Add a tick, or replace it if it was planned again."""
        row = _row(frame)
        with self._lock:
            last = self._last
            if last is None or last.source is not frame.source:
                self._clear()
                last = None
            advanced = last is not None and frame.epoch == last.epoch and frame.time > last.time
            at = int(np.searchsorted(self._rows[: self._count, 0], frame.time - 1e-9))
            is_closed_loop = frame.source.closed_loop
            if advanced and at < self._count and is_closed_loop:
                self._fork(at)
            self._put(at, row)
            self._events += _events(last, frame)
            self._compare(row)
            self._outcome = frame.outcome if frame.outcome is not None else self._outcome
            self._last = frame

    def past(self) -> Past:
        """Return everything so far."""
        with self._lock:
            rows = self._rows[: self._count].copy()
            return Past(rows, tuple(self._events), self._ghost, self._ghost_outcome, self._differs_at)

    def _clear(self) -> None:
        self._rows = np.empty((1024, len(COLUMNS)))
        self._count = 0
        self._events: list[Event] = []
        self._ghost = np.empty((0, len(COLUMNS)))
        self._ghost_outcome: str | None = None
        self._outcome: str | None = None
        self._differs_at: float | None = None
        self._last: Frame | None = None

    def _fork(self, at: int) -> None:
        """Move the rows from `at` on to the ghost: the flight continues from an earlier tick."""
        time = self._rows[at, 0]
        self._ghost, self._ghost_outcome, self._differs_at = self._rows[at : self._count].copy(), self._outcome, None
        self._outcome = None
        self._count = at
        self._events = [event for event in self._events if event.time < time or event.kind in ("parameters", "goal")]

    def _put(self, at: int, row: Rows) -> None:
        is_same_tick = at < self._count and abs(self._rows[at, 0] - row[0]) < 1e-9
        if not is_same_tick:
            if self._count == len(self._rows):
                self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))
            self._rows[at + 1 : self._count + 1] = self._rows[at : self._count]
            self._count += 1
        self._rows[at] = row

    def _compare(self, row: Rows) -> None:
        if self._differs_at is not None or not len(self._ghost):
            return
        at = int(np.searchsorted(self._ghost[:, 0], row[0] - 1e-9))
        is_beyond = at >= len(self._ghost)
        if is_beyond or np.abs(self._ghost[at, -3:] - row[-3:]).max() > _SAME:
            self._differs_at = float(row[0])


def true_clearance(frame: Frame) -> float:
    """Return the distance from the drone to the nearest surface [m], at most `CLEARANCE_MAX`.

    In a world of up to 3000 solids it is exact. Otherwise it is the distance to the nearest point of the cloud.
    """
    position = np.asarray(frame.observation.actual_state.position, dtype=np.float64)
    world = frame.source.world
    if world is not None and len(world.cylinders) + len(world.boxes) + len(world.spheres) <= _SOLIDS_MAX:
        distance = float(world.distance(position[None])[0])
    else:
        points = frame.plan.filtered_points
        distance = float(np.linalg.norm(points - position, axis=1).min(initial=np.inf))
    return float(np.clip(distance, 0.0, CLEARANCE_MAX))


def effective_samples(plan: Plan, instance: int, temperature: float) -> float:
    """Return the effective number of samples of an instance in Stage I, 1 / sum(w^2) with w the weights."""
    cost = np.asarray(plan.stage1_cost[instance], dtype=np.float64)
    weights = np.exp(-(cost - cost.min()) / temperature)
    return float(weights.sum() ** 2 / (weights**2).sum())


def _row(frame: Frame) -> Rows:
    plan, best, state = frame.plan, int(frame.plan.best), frame.observation.actual_state
    return np.array(
        (
            frame.time,
            np.linalg.norm(np.asarray(state.velocity)),
            true_clearance(frame),
            plan.stage2_cost[best],
            plan.goal_cost[best],
            plan.collision_cost[best],
            frame.timings_ms.get("plan", 0.0),
            np.count_nonzero(plan.clearance.min(axis=1) >= frame.config.candidates.safe_clearance),
            effective_samples(plan, best, frame.config.sampling.temperature),
            *np.asarray(state.position, dtype=np.float64),
        )
    )


def _events(last: Frame | None, frame: Frame) -> list[Event]:
    events: list[Event] = []
    if last is None:
        return events
    if last.config is not frame.config:
        paths = [
            info.path
            for info in PlannerConfig.parameters()
            if last.config.get(info.path) != frame.config.get(info.path)
        ]
        changes = [f"{path} {last.config.get(path)} → {frame.config.get(path)}" for path in paths]
        events.append(Event(frame.time, "parameters", ", ".join(changes)))
    is_same_time = last.time == frame.time
    if is_same_time and not np.array_equal(last.observation.goal.position, frame.observation.goal.position):
        place = ", ".join(f"{x:g}" for x in np.asarray(frame.observation.goal.position))
        events.append(Event(frame.time, "goal", f"goal moved to {place}"))
    is_braking, was_braking = (f.plan.status == PlanStatus.NO_SAFE_CANDIDATE for f in (frame, last))
    if is_braking and not was_braking and frame.epoch == last.epoch:
        events.append(Event(frame.time, "braking", "no safe candidate: stopping"))
    if frame.outcome is not None and (last.outcome is None or last.epoch != frame.epoch):
        events.append(Event(frame.time, "end", frame.outcome.replace("_", " ")))
    return events
