"""The success of a benchmark over two quantities: the series of its plot, and the horizontal axis."""

from __future__ import annotations

import statistics

from aero_viz.evaluation.bench.runner import Run
from aero_viz.evaluation.bench.sudden_object import can_evade
from aero_viz.evaluation.bench.suites import Row
from aero_viz.planners.registry import config_of_entry

IMPOSSIBLE_NOTE = (
    "x: a drone with this mass, thrust and body rates cannot evade the object from straight and level flight, even if "
    "it knows of it at once. The speed is the lowest at which a drone of the cell flew when the object appeared."
)


def format_matrix(run: Run) -> list[list[str]]:
    """Return the success in per cent as a table with a header and a line per series; empty if there are no series."""
    rows = {(row.series, row.x): row for row in run.benchmark.rows if row.series and row.x is not None}
    if not rows or run.benchmark.metric != "success":
        return []
    series, positions = (list(dict.fromkeys(column)) for column in zip(*rows, strict=True))
    lines = [[name, *(_cell(run, rows.get((name, x))) for x in positions)] for name in series]
    if any(row.sudden for row in rows.values()):
        lines.append(["mean speed then [m/s]", *(_speed(run, x) for x in positions)])
    return [[run.benchmark.x_label, *(f"{x:g}" for x in positions)], *lines]


def _cell(run: Run, row: Row | None) -> str:
    """Return the success of a row in per cent, with an x if no drone could arrive; empty without flights."""
    if row is None:
        return ""
    arrived = [flight["arrived"] for flight in run.flights if flight["row"] == row.label]
    text = f"{100 * statistics.fmean(arrived):.0f}" if arrived else ""
    return text if _is_possible(run, row) else f"{text} x".strip()


def _speed(run: Run, x: float | None) -> str:
    """Return the mean speed of the drones when their objects appeared, at one position of the horizontal axis."""
    speeds = _speeds(run, {row.label for row in run.benchmark.rows if row.x == x})
    return f"{statistics.fmean(speeds):.1f}" if speeds else ""


def _speeds(run: Run, labels: set[str]) -> list[float]:
    flights = [flight for flight in run.flights if flight["row"] in labels]
    return [flight["object_speed"] for flight in flights if flight.get("object_speed") is not None]


def _is_possible(run: Run, row: Row) -> bool:
    if row.sudden is None:
        return True
    vehicle = config_of_entry(run.header).vehicle
    radius = run.header["simulation"]["rules"]["radius"]
    speed = min(_speeds(run, {row.label}), default=row.speed)
    return can_evade(row.sudden.distance, speed, vehicle=vehicle, radius=radius)
