"""Figures and events of every tick of a source, and of the flight that it is compared with, the ghost."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from aero_planner import PlanStatus
from aero_planner.config import DroneConfig
from aero_viz.dashboard.signals import read
from aero_viz.dashboard.tick_table import Rows, TickTable
from aero_viz.session.comparison import ComparisonEvent
from aero_viz.session.config_history import DRAG_INTERVAL
from aero_viz.session.frame import Frame

if TYPE_CHECKING:
    from aero_viz.logs.comparison import LoggedFlight

COLUMNS = ("time", "speed", "clearance", "plan_ms", "unsafe", "best", "x", "y", "z")
"""First columns of all rows: [s], [m/s], [m], [ms], 1 if no candidate was safe and 0 otherwise, number of the chosen
candidate, position [m]. Those of the other signals follow; see `signals.read`."""
PLACE = slice(COLUMNS.index("x"), COLUMNS.index("z") + 1)
"""Columns of the position."""
_EVENTS_MAX = 2000
"""Largest number of events: the newest ones."""
_SAME = 1e-4
"""Positions that differ by less than this count as equal [m]."""


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

    version: int
    """Changes with everything else here."""
    columns: Mapping[str, int]
    """Place of each column of the rows by the name of its signal. Older rows may be without the last ones."""
    rows: Rows
    """One row for each tick so far, in the order of time; the first columns are `COLUMNS`."""
    events: tuple[Event, ...]
    outcome: str | None
    """Outcome of the flight; None while it continues."""
    ghost: Rows
    """Rows of the ghost: the flight of configuration A, that of a log, or the future that was left when the flight last
    forked. Empty without one."""
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

    def column(self, name: str, *, of_ghost: bool = False) -> Rows:
        """Return the numbers of a signal, of the flight or of its ghost, NaN where they are unknown."""
        rows, place = self.ghost if of_ghost else self.rows, self.columns.get(name, 1 << 30)
        return rows[:, place] if place < rows.shape[1] else np.full(len(rows), np.nan)

    def alternative_to(self, frame: Frame) -> Frame | None:
        """Return the plan of configuration A for the tick of `frame`; None if there is none."""
        a = self.alternative
        return a if a is not None and a.source is frame.source and a.time == frame.time else None


class FlightHistory:
    """Keeps a row for every tick. Safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._version = 0
        self._pinned: DroneConfig | None = None
        self._alternative: Frame | None = None
        self._ghost_name = "before"
        self._clear()

    def add(self, frame: Frame) -> None:
        """Add a tick, or replace it if it was planned again."""
        row = read(frame)
        with self._lock:
            self._version += 1
            last = self._last
            if last is None or last.source is not frame.source:
                self._clear()
                last = None
            advanced = last is not None and frame.epoch == last.epoch and frame.time > last.time
            at = self._ticks.place_of(frame.time)
            if advanced and at < len(self._ticks) and frame.source.closed_loop:
                self._fork(at)
            self._ticks.put(row)
            self._add_events(last, frame)
            self._outcome = frame.outcome if frame.outcome is not None else self._outcome
            self._last = frame

    def compare(self, event: ComparisonEvent) -> None:
        """Follow the comparison with configuration A: its plan of the present tick, and its flight as the ghost."""
        row = read(event.frame) if event.kind == "flown" and event.frame is not None else None
        with self._lock:
            self._version += 1
            self._pinned = event.config
            if event.kind in ("pinned", "unpinned"):
                self._alternative = None
            if event.kind == "planned":
                self._alternative = event.frame
            elif event.kind != "flown":
                self._set_ghost(None, None)
                self._ghost_name = "before" if event.kind == "unpinned" else "A"
            elif row is not None and event.frame is not None:
                if not len(self._ghost):  # B may go back beyond the fork and change these rows
                    self._common = self._ticks.rows[: self._ticks.place_of(event.frame.time)]
                self._ghost.put(row)
                self._ghost_outcome = event.frame.outcome

    def lay_beside(self, flight: LoggedFlight | None) -> None:
        """Make the flight of a log the ghost, from the same start on; None removes a ghost."""
        with self._lock:
            self._version += 1
            ghost = TickTable(self._columns)
            start = float(self._ticks.rows[0, 0]) if len(self._ticks) else 0.0
            columns = {} if flight is None else flight.columns
            for values in zip(*columns.values(), strict=True):
                tick = dict(zip(columns, values, strict=True))
                ghost.put({**tick, "time": tick["time"] + start})
            self._set_ghost(ghost, None if flight is None else flight.outcome)
            self._ghost_name = "before" if flight is None else flight.name

    def past(self) -> Past:
        """Return everything so far."""
        with self._lock:
            rows, ghost = self._ticks.rows, self._ghost.rows
            is_recording = self._last is not None and not self._last.source.closed_loop
            differs_at = first_difference(rows, ghost, has_ended=self._ghost_outcome is not None, plans=is_recording)
            return Past(
                self._version, dict(self._columns), rows, tuple(self._events), self._outcome, ghost, self._common,
                self._ghost_outcome, self._ghost_name, differs_at, self._pinned, self._alternative,
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
        self._events = (self._events + events)[-_EVENTS_MAX:]

    def _clear(self) -> None:
        self._configs_before: dict[float, DroneConfig] = {}
        """Configuration before the changes at a tick, by its time [s]."""
        self._drag: tuple[frozenset[str], float, float] = frozenset(), -np.inf, 0.0
        """Paths of the parameters that have changed last, when that was [s], and the source time of its event [s]."""
        self._columns = {name: place for place, name in enumerate(COLUMNS)}
        self._ticks = TickTable(self._columns)
        self._events: list[Event] = []
        self._set_ghost(None, None)
        self._ghost_name = "A" if self._ghost_name == "A" else "before"
        self._outcome: str | None = None
        self._last: Frame | None = None

    def _set_ghost(self, ghost: TickTable | None, outcome: str | None) -> None:
        self._ghost, self._ghost_outcome = TickTable(self._columns) if ghost is None else ghost, outcome
        self._common = self._ghost.rows[:0]

    def _fork(self, at: int) -> None:
        """Continue from an earlier tick. The rows from `at` on become the ghost, unless that is another flight."""
        common = self._ticks.rows[:at]
        later = self._ticks.split(at)
        time = later.rows[0, 0]
        if self._ghost_name == "before":
            self._set_ghost(later, self._outcome)
            self._common = common
        self._outcome = None
        self._events = [event for event in self._events if event.time < time or event.kind in ("parameters", "goal")]


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
    best = COLUMNS.index("best")
    columns, tolerance = (slice(best, best + 1), 0.0) if plans else (PLACE, _SAME)
    distance = np.abs(ghost[np.minimum(at, len(ghost) - 1), columns] - rows[:, columns]).max(axis=1)
    differs = np.flatnonzero(np.where(is_beyond, has_ended, distance > tolerance))
    return float(rows[differs[0], 0]) if len(differs) else None


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
