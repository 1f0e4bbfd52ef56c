"""Figures and events of every tick of a source, and of the flight that it is compared with, the ghost."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig, PlanStatus
from aero_planner.config import DroneConfig
from aero_viz.logs.flight_figures import CLEARANCE_MAX
from aero_viz.planners.plan import ensemble
from aero_viz.session.comparison import ComparisonEvent
from aero_viz.session.config_history import DRAG_INTERVAL
from aero_viz.session.frame import Frame

COLUMNS = (
    "time", "speed", "clearance", "cost", "goal_cost", "collision_cost", "third_cost", "fourth_cost", "plan_ms", "safe",
    "clear", "unsafe", "samples", "best", "x", "y", "z",
)  # fmt: skip
"""Columns of the rows: [s], [m/s], [m], cost of the chosen candidate and up to four of its terms, [ms], number of safe
candidates, number of those with the safe clearance, 1 if no candidate was safe and 0 otherwise, effective number of
samples of the chosen instance, number of that instance, position [m]. NaN where nothing is known."""
_TERMS = 4
"""Number of terms of the cost that have a column."""
_SOLIDS_MAX = 3000
"""Largest number of solids for which the exact clearance is computed at every tick."""
_SAME = 1e-4
"""Positions that differ by less than this count as equal [m]."""

Rows = NDArray[np.float64]


class Event(NamedTuple):
    """Something that happened at a tick."""

    time: float
    """Source time [s]."""
    kind: str
    """"braking", "parameters", "goal", or how the flight ended, such as "arrived"."""
    text: str


@dataclass(frozen=True, eq=False)
class Past:
    """State of a history at one moment. Arrays are read-only."""

    rows: Rows
    """One row for each tick so far, in the order of time, with the columns `COLUMNS`."""
    events: tuple[Event, ...]
    outcome: str | None
    """Outcome of the flight; None while it continues."""
    ghost: Rows
    """Rows of the ghost: the flight of configuration A, or the future that was left when the flight last forked. Empty
    without either."""
    common: Rows
    """Rows before those of the ghost: the part of the flight that both share."""
    ghost_outcome: str | None
    """Outcome of the ghost; None if it was left while running."""
    ghost_name: str
    """"A", "before" for the future that was left, or the name of another log."""
    differs_at: float | None
    """First time at which the flight differs from the ghost [s]; None as long as it does not. In a recording, whose
    motion is given, another instance is chosen."""
    pinned: DroneConfig | None
    """Configuration A; None while nothing is compared."""
    alternative: Frame | None
    """Newest plan of configuration A, which may be that of another tick; see `alternative_to`."""

    def alternative_to(self, frame: Frame) -> Frame | None:
        """Return the plan of configuration A for the tick of `frame`; None if there is none."""
        a = self.alternative
        return a if a is not None and a.source is frame.source and a.time == frame.time else None


class FlightHistory:
    """Keeps a row for every tick. Safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pinned: DroneConfig | None = None
        self._alternative: Frame | None = None
        self._ghost_name = "before"
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
            at = self._place_of(frame.time)
            is_closed_loop = frame.source.closed_loop
            if advanced and at < self._count and is_closed_loop:
                self._fork(at)
            self._put(at, row)
            self._add_events(last, frame)
            self._outcome = frame.outcome if frame.outcome is not None else self._outcome
            self._last = frame

    def compare(self, event: ComparisonEvent) -> None:
        """Follow the comparison with configuration A: its plan of the present tick, and its flight as the ghost."""
        row = _row(event.frame) if event.kind == "flown" and event.frame is not None else None
        with self._lock:
            self._pinned = event.config
            if event.kind in ("pinned", "unpinned"):
                self._alternative = None
            if event.kind == "planned":
                self._alternative = event.frame
            elif event.kind != "flown":
                self._set_ghost([], None)
                self._ghost_name = "before" if event.kind == "unpinned" else "A"
            elif row is not None and event.frame is not None:
                if not self._ghost:  # B may go back beyond the fork and change these rows
                    self._common = self._rows[: self._place_of(event.frame.time)].copy()
                self._ghost.append(row)
                self._ghost_outcome = event.frame.outcome

    def past(self) -> Past:
        """Return everything so far."""
        with self._lock:
            rows = self._rows[: self._count].copy()
            if len(self._ghost_rows) != len(self._ghost):
                self._ghost_rows = np.array(self._ghost)
            ghost = self._ghost_rows
            is_recording = self._last is not None and not self._last.source.closed_loop
            differs_at = first_difference(rows, ghost, has_ended=self._ghost_outcome is not None, plans=is_recording)
            return Past(
                rows, tuple(self._events), self._outcome, ghost, self._common, self._ghost_outcome, self._ghost_name,
                differs_at, self._pinned, self._alternative,
            )  # fmt: skip

    def _add_events(self, last: Frame | None, frame: Frame) -> None:
        """Add what has happened since the last frame. A tick and a drag have the net change of parameters."""
        events = _events(last, frame)
        if last is not None and last.config is not frame.config:
            now, paths = time.monotonic(), frozenset(last.config.differences(frame.config))
            dragged, dragged_at, event_time = self._drag
            is_same_drag = paths == dragged and now - dragged_at < DRAG_INTERVAL
            self._drag = paths, now, frame.time
            replaced = {frame.time, event_time} if is_same_drag else {frame.time}
            before = self._configs_before.get(event_time, last.config) if is_same_drag else last.config
            before = self._configs_before.setdefault(frame.time, before)
            self._events = [e for e in self._events if e.kind != "parameters" or e.time not in replaced]
            if text := change_text(before, frame.config):
                events.insert(0, Event(frame.time, "parameters", text))
        self._events += events

    def _clear(self) -> None:
        self._configs_before: dict[float, DroneConfig] = {}
        """Configuration before the changes at a tick, by its time [s]."""
        self._drag: tuple[frozenset[str], float, float] = frozenset(), -np.inf, 0.0
        """Paths of the parameters that have changed last, when that was [s], and the source time of its event [s]."""
        self._rows = np.empty((1024, len(COLUMNS)))
        self._count = 0
        self._events: list[Event] = []
        self._set_ghost([], None)
        self._outcome: str | None = None
        self._last: Frame | None = None

    def _set_ghost(self, rows: list[Rows], outcome: str | None) -> None:
        self._ghost, self._ghost_outcome = rows, outcome
        self._ghost_rows = self._common = np.empty((0, len(COLUMNS)))

    def _place_of(self, time: float) -> int:
        """Return the number of rows before a time [s]."""
        return int(np.searchsorted(self._rows[: self._count, 0], time - 1e-9))

    def _fork(self, at: int) -> None:
        """Continue from an earlier tick. The rows from `at` on become the ghost, unless that is the flight of A."""
        time = self._rows[at, 0]
        if self._ghost_name != "A":
            self._set_ghost(list(self._rows[at : self._count].copy()), self._outcome)
            self._common = self._rows[:at].copy()
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


def first_difference(rows: Rows, ghost: Rows, *, has_ended: bool, plans: bool = False) -> float | None:
    """Return the first time at which a flight differs from its ghost [s]; None if it does not.

    Args:
        rows: rows of the flight.
        ghost: rows of the ghost.
        has_ended: True if the ghost has ended, so that a flight that continues differs from it.
        plans: compare the instances that are chosen, not the positions.
    """
    if not len(ghost):
        return None
    rows = rows[rows[:, 0] >= ghost[0, 0] - 1e-9]
    at = np.searchsorted(ghost[:, 0], rows[:, 0] - 1e-9)
    is_beyond = at >= len(ghost)
    columns, tolerance = ([COLUMNS.index("best")], 0.0) if plans else (list(range(-3, 0)), _SAME)
    distance = np.abs(ghost[np.minimum(at, len(ghost) - 1)][:, columns] - rows[:, columns]).max(axis=1)
    differs = np.flatnonzero(np.where(is_beyond, has_ended, distance > tolerance))
    return float(rows[differs[0], 0]) if len(differs) else None


def is_clearance_true(frame: Frame) -> bool:
    """Return True if `drone_clearance` is the distance to the world itself, not to the cloud."""
    world = frame.world
    return world is not None and len(world.cylinders) + len(world.boxes) + len(world.spheres) <= _SOLIDS_MAX


def drone_clearance(frame: Frame) -> float:
    """Return the distance from the drone to the nearest surface [m], at most `CLEARANCE_MAX`.

    In a world of up to 3000 solids it is exact. Otherwise it is the distance to the nearest point of the cloud.
    """
    position, world = frame.drone_position, frame.world
    if world is not None and is_clearance_true(frame):
        distance = float(world.distance(position[None])[0])
    else:
        plan = ensemble(frame.plan)
        points = frame.observation.points if plan is None else plan.filtered_points
        distance = float(np.linalg.norm(points - position, axis=1).min(initial=np.inf))
    return float(np.clip(distance, 0.0, CLEARANCE_MAX))


def effective_samples(plan: Plan, instance: int, temperature: float | None = None) -> float:
    """Return the effective number of samples of an instance in Stage I, 1 / sum(w^2) with w the weights.

    Args:
        plan: with the costs of the samples.
        instance: its index.
        temperature: of the weights; None is that of the plan. NaN where neither is known.
    """
    if temperature is None:
        temperature = math.nan if plan.temperature is None else float(plan.temperature[instance])
    cost = np.asarray(plan.stage1_cost[instance], dtype=np.float64)
    weights = np.exp(-(cost - cost.min()) / temperature)
    return float(weights.sum() ** 2 / (weights**2).sum())


def _row(frame: Frame) -> Rows:
    plan, best, state = frame.plan, int(frame.plan.best), frame.observation.actual_state
    terms = [float(cost[best]) for cost in plan.costs.values()] + [np.nan] * _TERMS
    full, config, clear, effective = ensemble(plan), frame.config, np.nan, np.nan
    if full is not None and isinstance(config, PlannerConfig):
        clear = np.count_nonzero(plan.clearance.min(axis=1) >= config.candidates.safe_clearance)
        effective = effective_samples(full, best)
    return np.array(
        (
            frame.time,
            np.linalg.norm(np.asarray(state.velocity)),
            drone_clearance(frame),
            plan.cost[best],
            *terms[:_TERMS],
            frame.timings_ms.get("plan", 0.0),
            np.nan if frame.is_safe is None else np.count_nonzero(frame.is_safe),
            clear,
            plan.status == PlanStatus.NO_SAFE_CANDIDATE,
            effective,
            best,
            *np.asarray(state.position, dtype=np.float64),
        )
    )


def change_text(before: DroneConfig, now: DroneConfig, *, most: int = 4) -> str:
    """Return the parameters that differ, with titles and units as in the tab Tune; empty if none does.

    Args:
        before: configuration before.
        now: configuration since.
        most: largest number of parameters to name.
    """
    changes = [
        f"{now.find(path).title}: {_rounded(old)} → {_rounded(new)}"
        for path, (old, new) in before.differences(now).items()
    ]
    more = [f"{len(changes) - most} more parameters"] if len(changes) > most else []
    return "; ".join(changes[:most] + more)


def _rounded(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _events(last: Frame | None, frame: Frame) -> list[Event]:
    events: list[Event] = []
    if last is None:
        return events
    is_same_time = last.time == frame.time
    if is_same_time and not np.array_equal(last.observation.goal.position, frame.observation.goal.position):
        place = ", ".join(f"{x:g}" for x in np.asarray(frame.observation.goal.position))
        events.append(Event(frame.time, "goal", f"goal moved to {place}"))
    is_braking, was_braking = (f.plan.status == PlanStatus.NO_SAFE_CANDIDATE for f in (frame, last))
    if is_braking and not was_braking and frame.epoch == last.epoch:
        events.append(Event(frame.time, "braking", "no safe candidate: stopping"))
    if frame.outcome is not None and (last.outcome is None or last.epoch != frame.epoch):
        events.append(Event(frame.time, frame.outcome, frame.outcome.replace("_", " ")))
    return events
