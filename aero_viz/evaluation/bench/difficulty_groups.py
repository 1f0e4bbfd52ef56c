"""Flights of a benchmark in groups of worlds of similar difficulty."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from aero_viz.evaluation.bench.runner import Run
from aero_viz.evaluation.statistics import wilson_interval

DIFFICULTY = ("traversability_obstruction", "view_occlusion", "angle_over_length", "guide_length", "difficulty")
"""Fields of a record about the difficulty of its world."""
GROUPS_NOTE = (
    "The worlds of a row, ordered by difficulty and divided into thirds. TO is FlightBench's traversability "
    "obstruction, VO its view occlusion and AOL its angle over length [1/m] (means, ± one standard deviation); the "
    "difficulty is their sum. Worlds without a path have none."
)
_HEADER = ("row", "third", "difficulty", "TO", "VO", "AOL", "arrived", "success", "95 % interval")
_THIRDS = ("easiest", "middle", "hardest")
_FLIGHTS_MIN = 2
"""Smallest number of flights of a third."""


def format_groups(run: Run) -> list[list[str]]:
    """Return a table with a header and up to three lines per row; empty if no row has six flights of known difficulty.

    Of worlds from files, all rows are one.
    """
    rows: dict[str, list[Mapping[str, Any]]] = {}
    for flight in run.flights:
        if flight.get("difficulty") is not None:
            rows.setdefault("all worlds" if run.benchmark.worlds else flight["row"], []).append(flight)
    lines = []
    for label, flights in rows.items():
        ordered = sorted(flights, key=lambda flight: flight["difficulty"])
        ends = [len(ordered) * k // len(_THIRDS) for k in range(len(_THIRDS) + 1)]
        if len(ordered) >= _FLIGHTS_MIN * len(_THIRDS):
            lines += [[label, name, *_cells(ordered[ends[k] : ends[k + 1]])] for k, name in enumerate(_THIRDS)]
    return [list(_HEADER), *lines] if lines else []


def _cells(flights: Sequence[Mapping[str, Any]]) -> list[str]:
    arrived = sum(flight["arrived"] for flight in flights)
    low, high = wilson_interval(arrived, len(flights))
    metrics = [[flight[name] for flight in flights] for name in DIFFICULTY[:3]]
    return [
        f"{flights[0]['difficulty']:.2f} to {flights[-1]['difficulty']:.2f}",
        *map(mean_std, metrics),
        f"{arrived}/{len(flights)}",
        f"{100 * arrived / len(flights):.0f} %",
        f"{100 * low:.0f} to {100 * high:.0f} %",
    ]


def mean_std(values: Sequence[float]) -> str:
    """Return the mean, ± one standard deviation of several values."""
    mean = f"{statistics.fmean(values):.3g}"
    return f"{mean} ± {statistics.stdev(values):.2g}" if len(values) > 1 else mean
