"""The cost that a search minimises."""

import dataclasses
import math
import statistics

import pytest

from aero_viz.evaluation.tune.objectives import OBJECTIVES, Objective, flight_cost, front_values
from aero_viz.flight import FlightResult

ARRIVED = FlightResult(
    arrived=True, reason="arrived", flight_time_s=8.0, mean_speed=1.0, max_speed=1.0, end_speed=1.0, smoothness=300.0,
    length_m=1.0, mean_clearance=None, min_clearance=0.4, plan_ms_median=None, seed=0, scene="s", config="c",
)  # fmt: skip
COLLIDED = dataclasses.replace(ARRIVED, arrived=False, reason="collision", flight_time_s=1.0, smoothness=1.0)


def mean_cost(flights: list[FlightResult], objective: Objective) -> float:
    return statistics.fmean(flight_cost(flight, objective) for flight in flights)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_arrivals_count_before_every_objective(objective: Objective):
    slow = dataclasses.replace(ARRIVED, flight_time_s=60.0, smoothness=9000.0, min_clearance=0.0)
    assert mean_cost([slow] * 99 + [slow], objective) < mean_cost([ARRIVED] * 99 + [COLLIDED], objective)


@pytest.mark.parametrize(
    ("objective", "better"),
    [("time", {"flight_time_s": 7.9}), ("clearance", {"min_clearance": 0.5}), ("smoothness", {"smoothness": 299.0})],
)
def test_the_objective_decides_between_equal_arrivals(objective: Objective, better: dict[str, float]):
    improved = dataclasses.replace(ARRIVED, **better)  # type: ignore[arg-type]
    assert mean_cost([improved, COLLIDED], objective) < mean_cost([ARRIVED, COLLIDED], objective)


def test_a_front_has_the_share_of_failures_and_means_over_arrivals():
    smooth = dataclasses.replace(ARRIVED, smoothness=100.0)
    assert front_values([ARRIVED, smooth, COLLIDED, COLLIDED], ("time", "smoothness")) == [0.5, 8.0, 200.0]
    assert front_values([COLLIDED], ("clearance",)) == [1.0, math.inf]
