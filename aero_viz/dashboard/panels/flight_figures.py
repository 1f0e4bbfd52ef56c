"""Figures of a flight, as texts for a table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.dashboard.history import COLUMNS

__all__ = ["FIGURES", "flight_figures"]

FIGURES = (
    "outcome", "time [s]", "length [m]", "mean speed [m/s]", "smallest clearance [m]", "median plan time [ms]",
    "ticks without safe candidate",
)  # fmt: skip
"""Labels of the figures."""


def flight_figures(rows: NDArray[np.float64], outcome: str) -> tuple[str, ...]:
    """Return the figures of a flight in the order of `FIGURES`.

    Args:
        rows: rows of a flight's history, at least one.
        outcome: what it came to.
    """
    column = {name: rows[:, i] for i, name in enumerate(COLUMNS)}
    length = float(np.linalg.norm(np.diff(rows[:, -3:], axis=0), axis=1).sum())
    return (
        outcome.replace("_", " "),
        f"{column['time'][-1]:.2f}",
        f"{length:.1f}",
        f"{column['speed'].mean():.2f}",
        f"{column['clearance'].min():.2f}",
        f"{np.median(column['plan_ms']):.1f}",
        f"{np.count_nonzero(column['safe'] == 0)}",
    )
