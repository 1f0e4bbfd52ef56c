"""Causes of the failures of a benchmark: each failed flight is flown again, alone, and explained."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from aero_viz.errors import UserError
from aero_viz.explain.post_mortem import explain_flight
from aero_viz.explain.trace import FlightTrace, recorder
from aero_viz.flight import fly
from aero_viz.scenes import World


def cause_of(world: World, reason: str, **options: Any) -> dict[str, Any]:
    """Fly a failed flight again and return its cause and obstacle, as fields of its record.

    Args:
        world: where it was flown.
        reason: how it ended.
        options: arguments of `fly`.

    Raises:
        FlightInterrupted: Ctrl-C was pressed.
    """
    trace = FlightTrace()
    try:
        result = fly(world, recorder=recorder(trace), **options)
    except UserError as error:
        return {"cause": f"not explained: {error}", "obstacle": None}
    if result.reason != reason:
        return {"cause": f"{reason}; not repeated when flown alone", "obstacle": None}
    report, _ = explain_flight(trace)
    return {"cause": report.cause, "obstacle": report.obstacle}


def cause_rows(flights: Iterable[Mapping[str, Any]]) -> list[tuple[str, int, str]]:
    """Return cause, number of flights, and row and seed of up to three of their worlds; the most frequent first."""
    failed = [flight for flight in flights if flight.get("cause")]
    counts = Counter(flight["cause"] for flight in failed)
    rows = []
    for cause, count in counts.most_common():
        examples = [f"{f['row']} {f['world_seed']}" for f in failed if f["cause"] == cause][:3]
        rows.append((cause, count, ", ".join(examples)))
    return rows
