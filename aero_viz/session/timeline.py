"""The ticks so far, each of which can be returned to exactly."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.planner import History

__all__ = ["Mark", "Timeline"]

_CAPACITY = 30_000
"""Ticks that can be returned to: ten minutes of flight at 50 Hz."""


@dataclass(frozen=True, eq=False, slots=True)
class Mark:
    """All that repeats one tick bit for bit."""

    time: float
    """Time in the source [s]."""
    checkpoint: object
    """Of the source, before the tick's plan is flown."""
    history: History
    """Of the planner, before the tick's plan."""


class Timeline:
    """Marks of the ticks flown, and a cursor at the present one. Going on from an earlier tick forgets the later
    ones."""

    def __init__(self) -> None:
        self._marks: list[Mark] = []
        self._forgotten = 0
        self._cursor = -1
        self._positions = np.empty((1024, 3), dtype=np.float32)
        self._shared_rows = 0

    def __bool__(self) -> bool:
        return self._cursor >= 0

    @property
    def index(self) -> int:
        """Number of the present tick since the start."""
        return self._forgotten + self._cursor

    @property
    def earlier(self) -> int:
        """Number of earlier ticks that can be returned to."""
        return self._cursor

    @property
    def present(self) -> Mark:
        """Mark of the present tick."""
        return self._marks[self._cursor]

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that can be returned to [s]."""
        return (self._marks[0].time, self._marks[-1].time) if self._marks else (0.0, 0.0)

    def append(self, mark: Mark, position: ArrayLike) -> None:
        """Add a tick after the present one, flown through `position` [m], shape [3]."""
        del self._marks[self._cursor + 1 :]
        self._marks.append(mark)
        if len(self._marks) > _CAPACITY:
            del self._marks[0]
            self._forgotten += 1
        self._cursor = len(self._marks) - 1
        row = self.index
        if row >= len(self._positions):
            self._positions = np.concatenate((self._positions, np.empty_like(self._positions)))
        elif row < self._shared_rows:
            # Trails handed out before still show this row as it was.
            self._positions = self._positions.copy()
        self._positions[row] = position
        self._shared_rows = row + 1

    def amend(self, checkpoint: object) -> None:
        """Let the present tick be returned to with another checkpoint."""
        self._marks[self._cursor] = dataclasses.replace(self.present, checkpoint=checkpoint)

    def trail(self) -> NDArray[np.float32]:
        """Return the positions up to the present tick [m], shape [n, 3], read-only, never changed later."""
        trail = self._positions[: self.index + 1]
        trail.flags.writeable = False
        return trail

    def go_to_time(self, time: float) -> Mark:
        """Move the cursor to the last tick at or before `time` [s], or to the first."""
        times = [mark.time for mark in self._marks]
        return self.go_by(int(np.searchsorted(times, time + 1e-9, side="right")) - 1 - self._cursor)

    def go_by(self, count: int) -> Mark:
        """Move the cursor by `count` ticks, within what is known."""
        self._cursor = min(max(self._cursor + count, 0), len(self._marks) - 1)
        return self.present
