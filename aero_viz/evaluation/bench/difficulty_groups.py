"""Flights of a benchmark in groups of worlds of similar difficulty."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from aero_viz.evaluation.bench.runner import Run
from aero_viz.statistics import wilson_interval

DIFFICULTY = ("traversability_obstruction", "view_occlusion", "angle_over_length", "guide_length", "difficulty")
"""Fields of a record about the difficulty of its world."""
GROUPS_NOTE = (
    "The worlds of a row, ordered by difficulty and divided into thirds. TO is FlightBench's traversability "
    "obstruction, VO its view occlusion and AOL its angle over length [1/m] (means, ± one standard deviation); the "
    "difficulty is their sum. Worlds without a path have none. The intervals are over flights."
)
_HEADER = ("row", "third", "difficulty", "TO", "VO", "AOL", "arrived", "success", "95 % interval")
_THIRDS = ("easiest", "middle", "hardest")
_WORLDS_MIN = 2
"""Smallest number of worlds of a third."""
_Flights = Sequence[Mapping[str, Any]]


def format_groups(run: Run) -> list[list[str]]:
    """Return a table with a header and up to three lines per row; empty if no row has six worlds of known difficulty.

    Of worlds from files, all rows are one. All flights through a world are in the same third.
    """
    rows: dict[str, dict[Any, list[Mapping[str, Any]]]] = {}
    for flight in run.flights:
        if flight.get("difficulty") is not None:
            is_file = bool(run.benchmark.worlds)
            worlds = rows.setdefault("all worlds" if is_file else flight["row"], {})
            worlds.setdefault(flight["row"] if is_file else flight["world_seed"], []).append(flight)
    lines = []
    for label, worlds in rows.items():
        ordered = sorted(worlds.values(), key=lambda flights: flights[0]["difficulty"])
        ends = [len(ordered) * k // len(_THIRDS) for k in range(len(_THIRDS) + 1)]
        if len(ordered) >= _WORLDS_MIN * len(_THIRDS):
            lines += [[label, name, *_cells(ordered[ends[k] : ends[k + 1]])] for k, name in enumerate(_THIRDS)]
    return [list(_HEADER), *lines] if lines else []


def _cells(worlds: Sequence[_Flights]) -> list[str]:
    """Return the cells of a third, from the flights through each of its worlds."""
    flights = [flight for each in worlds for flight in each]
    arrived = sum(flight["arrived"] for flight in flights)
    low, high = wilson_interval(arrived, len(flights))
    metrics = [[each[0][name] for each in worlds] for name in DIFFICULTY[:3]]
    return [
        f"{flights[0]['difficulty']:.2f} to {flights[-1]['difficulty']:.2f}",
        *map(mean_std, metrics),
        f"{arrived}/{len(flights)}",
        f"{100 * arrived / len(flights):.0f} %",
        f"{100 * low:.0f} to {100 * high:.0f} %",
    ]


def mean_std(values: Sequence[float]) -> str:
    """Return the mean, ± one standard deviation of several values; a deviation by rounding is 0."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return f"{mean:.3g}"
    deviation = statistics.stdev(values)
    return f"{mean:.3g} ± {deviation if deviation > 1e-9 * abs(mean) else 0.0:.2g}"
