"""Objectives of a search: the share of flights that arrive, and their means."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from typing import Literal

from aero_viz.flight import FlightResult

Objective = Literal["time", "clearance", "smoothness"]

_COSTS: dict[Objective, Callable[[FlightResult], float]] = {
    "time": lambda flight: flight.flight_time_s,
    "clearance": lambda flight: -(flight.min_clearance or 0.0),
    "smoothness": lambda flight: flight.smoothness,
}
"""Cost of a flight that arrives, by objective; smaller is better."""
OBJECTIVES = tuple(_COSTS)
UNITS: dict[Objective, str] = {"time": "s", "clearance": "m", "smoothness": "m²/s⁵"}
NAMES: dict[Objective, str] = {"time": "time", "clearance": "min clearance", "smoothness": "smoothness"}
"""Name of what an objective takes the mean of: the clearance of a flight is its smallest one, `min_clearance`."""
_TIE_BREAK = 1e-6
"""Weight of an objective against the arrival of a flight. It decides only between equal numbers of arrivals."""


def flight_cost(flight: FlightResult, objective: Objective) -> float:
    """Return the cost of one flight for a search with a single objective.

    The mean over equally many flights orders candidates by the share of flights that arrive and, where that is equal,
    by the mean of the objective over those that do.
    """
    return _TIE_BREAK * _COSTS[objective](flight) if flight.arrived else 1.0


def front_values(flights: Sequence[FlightResult], objectives: Sequence[Objective]) -> list[float]:
    """Return the values of a candidate for a Pareto front, smaller is better.

    The first value is the share of flights that do not arrive. It is followed by the mean of each objective over the
    flights that do, which is infinite if none does.
    """
    arrived = [flight for flight in flights if flight.arrived]
    means = [statistics.fmean(map(_COSTS[name], arrived)) if arrived else math.inf for name in objectives]
    return [1.0 - len(arrived) / len(flights), *means]


def measure(flight: FlightResult, objective: Objective) -> float:
    """Return the value of an objective for a flight that arrives, in its unit; more clearance is better."""
    return abs(_COSTS[objective](flight))
