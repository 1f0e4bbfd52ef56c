"""History of a flight log, with another log as its ghost."""

from __future__ import annotations

import dataclasses

import numpy as np

from aero_viz.dashboard.history import COLUMNS, FlightHistory, Past
from aero_viz.dashboard.tick_table import Rows
from aero_viz.logs.comparison import LogComparison, LoggedFlight
from aero_viz.session.frame import Frame


class LoggedHistory(FlightHistory):
    """Shows the ticks of log B and, as the ghost, those of log A. What the session plans is left out.

    Args:
        logs: the two flights.
        start: source time of the first pose of B [s]; both flights begin there.
    """

    def __init__(self, logs: LogComparison, *, start: float) -> None:
        super().__init__()
        differs_at = logs.differs_at
        names = (*COLUMNS, *sorted({*logs.a.columns, *logs.b.columns} - {*COLUMNS}))
        self._logged = {
            "columns": {name: place for place, name in enumerate(names)},
            "rows": _rows(logs.b, names, start),
            "outcome": logs.b.outcome,
            "ghost": _rows(logs.a, names, start),
            "ghost_outcome": logs.a.outcome,
            "ghost_name": logs.a.name if logs.a.name != logs.b.name else "first log",
            "differs_at": None if differs_at is None else differs_at + start,
        }

    def add(self, frame: Frame) -> None:
        """Do nothing: the log holds every tick already."""

    def past(self) -> Past:
        """Return both flights as a whole."""
        return dataclasses.replace(super().past(), **self._logged)


def _rows(flight: LoggedFlight, names: tuple[str, ...], start: float) -> Rows:
    ticks = len(flight.columns["time"])
    rows = np.stack([flight.columns.get(name, np.full(ticks, np.nan)) for name in names], axis=1)
    rows[:, 0] += start
    return rows
