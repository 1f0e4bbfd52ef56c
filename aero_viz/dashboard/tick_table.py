"""Numbers of ticks in named columns, in the order of time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.float64]

CAPACITY = 30_000
"""Largest number of rows: ten minutes of flight at 50 Hz, as of the session's checkpoints."""
_SAME = 1e-9
"""Times that differ by less than this are one tick [s]."""


class TickTable:
    """A row for each tick. A column may come later, and the oldest tenth of the rows goes when `CAPACITY` is reached.

    Args:
        columns: place of each column by its name, the time [s] first. Tables that share it have the same columns.
    """

    def __init__(self, columns: dict[str, int]) -> None:
        self._columns = columns
        self._rows = np.empty((1024, len(columns)))
        self._count = 0
        self._shared = 0
        """Number of rows that `rows` has handed out and that therefore must not change."""

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Rows:
        """All rows so far, NaN where nothing is known. Read-only, and never changed later."""
        self._shared = max(self._shared, self._count)
        rows = self._rows[: self._count]
        rows.flags.writeable = False
        return rows

    def place_of(self, time: float) -> int:
        """Return the number of rows before a time [s]."""
        return int(np.searchsorted(self._rows[: self._count, 0], time - _SAME))

    def put(self, values: Mapping[str, float]) -> None:
        """Add a tick, or replace that of the same time. Names that are new become columns."""
        for name in values:
            self._columns.setdefault(name, len(self._columns))
        row = np.full(len(self._columns), np.nan)
        row[[self._columns[name] for name in values]] = list(values.values())
        at = self.place_of(row[0])
        is_same_tick = at < self._count and abs(self._rows[at, 0] - row[0]) < _SAME
        if not is_same_tick and self._count == CAPACITY:
            gone = min(CAPACITY // 10, at)
            self._move(self._rows[gone : self._count])
            at -= gone
        self._make_room(len(row), self._count + (not is_same_tick), is_changed=at < self._shared)
        if not is_same_tick:
            self._rows[at + 1 : self._count + 1] = self._rows[at : self._count]
            self._count += 1
        self._rows[at] = row

    def split(self, at: int) -> TickTable:
        """Remove the rows from number `at` on, and return them as a table."""
        later = TickTable(self._columns)
        later._move(self._rows[at : self._count])
        self._count = at
        return later

    def _make_room(self, columns: int, rows: int, *, is_changed: bool) -> None:
        """Make the array large enough, and another one before rows change that were handed out."""
        height, width = self._rows.shape
        if columns <= width and rows <= height and not is_changed:
            return
        self._move(self._rows[: self._count], height=height if rows <= height else 2 * height, width=columns)

    def _move(self, rows: Rows, *, height: int = 1024, width: int | None = None) -> None:
        moved = np.full((max(height, len(rows) + 1), width or len(self._columns)), np.nan)
        moved[: len(rows), : rows.shape[1]] = rows
        self._rows, self._count, self._shared = moved, len(rows), 0
