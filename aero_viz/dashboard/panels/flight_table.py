"""The figures of a flight and of its ghost, side by side."""

from __future__ import annotations

import numpy as np

from aero_viz.dashboard.history import COLUMNS, Past
from aero_viz.dashboard.panels import markup
from aero_viz.logs.flight_figures import LABELS, FlightFigures

_NAMES = {
    "A": (("A", "B"), "the flight of configuration A"),
    "before": (("before", "now"), "the future that was left"),
}
"""Headings and description of a ghost by its name."""


def fork_table(past: Past) -> str:
    """Return what the dashed curves are, and the figures of both flights; empty without a ghost."""
    if not len(past.ghost):
        return ""
    names, what = _NAMES.get(past.ghost_name, (("A", "B"), f"A, {past.ghost_name}"))
    same = "They do not differ so far." if past.differs_at is None else f"They first differ at {past.differs_at:.2f} s."
    solid = (
        "The flight was continued from an earlier tick" if past.ghost_name == "before" else "Two flights are compared"
    )
    note = markup.note(f"{solid}: the dashed curves are {what}. {same}")
    return f'<div class="aero-fork">{note}{flight_table(past, names)}</div>'


def flight_table(past: Past, names: tuple[str, str], *, ghost_state: str = "not over") -> str:
    """Return the figures of the ghost and of the flight as HTML, both from the start of the flight on.

    Args:
        past: the flight and its ghost, which must not be empty.
        names: heading of the ghost and of the flight.
        ghost_state: outcome of a ghost that has none.
    """
    first = len(COLUMNS)
    whole = np.vstack((past.common[:, :first], past.ghost[:, :first]))
    ghost = FlightFigures.from_columns(dict(zip(COLUMNS, whole.T, strict=True)), past.ghost_outcome or ghost_state)
    flight = FlightFigures.from_columns(
        dict(zip(COLUMNS, past.rows[:, :first].T, strict=True)), past.outcome or "flying"
    )
    rows = [tuple(row) for row in zip(LABELS, ghost.texts(), flight.texts(), strict=True)]
    return markup.columns(("flight", *names), rows)
