"""From flights to the lines of a table."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["METRICS", "Summary", "summarise", "wilson"]

METRICS = (
    "mean_speed", "max_speed", "smoothness", "length_m", "mean_clearance", "min_clearance", "flight_time_s",
)  # fmt: skip
"""Fields of `FlightResult` that are averaged, over the flights that arrived, as in the paper's table."""

_Z95 = 1.959963984540054


@dataclass(frozen=True)
class Summary:
    """One line of a table: the flights of one planner in one row."""

    row: str
    planner: str
    flights: int
    arrived: int
    success_rate: float
    """arrived / flights."""
    success_low: float
    success_high: float
    """Wilson score interval of the success rate, 95 %."""
    passable: float | None
    """Fraction of the worlds in which a path exists for the drone's radius; None where that was not looked at."""
    reasons: dict[str, int]
    """How many flights ended how; "incomplete" for a recorded one that just stops."""
    mean: dict[str, float | None]
    std: dict[str, float | None]
    """Of `METRICS` over the flights that arrived; None where none did. The deviation is that of a sample."""
    plan_ms_median: float | None
    """Median over the flights' batches: time of one plan for a whole batch [ms]."""
    flights_per_minute: float | None
    """Of wall time, all batches with these flights; None for included flights."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON can hold them."""
        return asdict(self)


def wilson(successes: int, trials: int, *, z: float = _Z95) -> tuple[float, float]:
    """Return the Wilson score interval of a rate; 95 % by default. (0, 1) without trials.

    Wilson 1927: (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n) with p = successes / n.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials are not possible.")
    if trials == 0:
        return 0.0, 1.0
    rate, n = successes / trials, float(trials)
    centre = rate + z * z / (2.0 * n)
    half = z * math.sqrt(rate * (1.0 - rate) / n + z * z / (4.0 * n * n))
    scale = 1.0 + z * z / n
    # Exact at the ends, where rounding would leave 1e-17 beyond them.
    low = 0.0 if successes == 0 else (centre - half) / scale
    high = 1.0 if successes == trials else (centre + half) / scale
    return low, high


def summarise(flights: Sequence[Mapping[str, Any]], *, row: str, planner: str) -> Summary:
    """Return the line of these flights: records of `Run.flights` or of an included table."""
    arrived = [flight for flight in flights if flight["arrived"]]
    low, high = wilson(len(arrived), len(flights))
    values = {name: [float(flight[name]) for flight in arrived if flight.get(name) is not None] for name in METRICS}
    passable = [bool(flight["passable"]) for flight in flights if flight.get("passable") is not None]
    batches = {flight["batch"]: flight for flight in flights if "batch" in flight}
    seconds = sum(batch["run_s"] * _share(batch, flights) for batch in batches.values())
    plan_ms = [batch["plan_ms_median"] for batch in batches.values() if batch["plan_ms_median"] is not None]
    return Summary(
        row=row,
        planner=planner,
        flights=len(flights),
        arrived=len(arrived),
        success_rate=len(arrived) / len(flights) if flights else 0.0,
        success_low=low,
        success_high=high,
        passable=sum(passable) / len(passable) if passable else None,
        reasons=dict(Counter(flight["reason"] or "incomplete" for flight in flights).most_common()),
        mean={name: statistics.fmean(v) if v else None for name, v in values.items()},
        std={name: statistics.stdev(v) if len(v) > 1 else None for name, v in values.items()},
        plan_ms_median=statistics.median(plan_ms) if plan_ms else None,
        flights_per_minute=60.0 * len(flights) / seconds if seconds > 0.0 else None,
    )


def _share(batch: Mapping[str, Any], flights: Sequence[Mapping[str, Any]]) -> float:
    """Return which part of a batch, shared with other rows, is of these flights."""
    return sum(flight.get("batch") == batch["batch"] for flight in flights) / batch["batch_size"]
