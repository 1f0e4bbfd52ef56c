"""Scores, the check and the conclusions."""

import dataclasses
import json

import pytest

from aero_planner import PlannerConfig
from aero_viz.evaluation.tune import Candidate, Check, ParameterRange, Score, TuningResult
from aero_viz.flight import FlightResult
from aero_viz.statistics import wilson_interval


def flight(time: float | None) -> FlightResult:
    """Return a flight that arrives after `time` [s], or collides if it is None."""
    return FlightResult(
        arrived=time is not None, reason="collision" if time is None else "arrived", flight_time_s=time or 1.0,
        mean_speed=1.0, max_speed=1.0, end_speed=1.0, smoothness=1.0, length_m=1.0, mean_clearance=None,
        min_clearance=None, plan_ms_median=None, seed=0, scene="s", config="c",
    )  # fmt: skip


def check(incumbent: list[float | None], best: list[float | None]) -> Check:
    return Check.from_results([flight(time) for time in incumbent], [flight(time) for time in best])


def test_a_score_counts_arrivals_and_their_mean_time():
    score, none = Score.from_results(map(flight, [2.0, 3.0, None])), Score.from_results([flight(None)])
    assert (score.flights, score.arrived, score.flight_time_s) == (3, 2, 2.5) and none.flight_time_s is None
    assert score.others == {"clearance": [0.0, 0.0], "smoothness": [1.0, 0.0]} and none.others["clearance"] == [
        None,
        None,
    ]
    assert (score.to_dict()["success_low"], score.to_dict()["success_high"]) == wilson_interval(2, 3)


@pytest.mark.parametrize(
    ("incumbent", "best", "verdict"),
    [
        ([None] * 6, [5.0] * 6, "better"),  # 2 / 2^6 = 0.031
        ([None] * 5, [5.0] * 5, "noise"),  # 2 / 2^5 = 0.063
        ([5.0] * 6, [None] * 6, "worse"),
        ([5.0] * 6, [4.9] * 6, "better"),
        ([5.0] * 6, [5.1] * 6, "worse"),
        ([5.0] * 8, [4.9] * 7 + [5.1], "noise"),  # 2 (1 + 8) / 2^8 = 0.070
        ([5.0] * 9, [4.9] * 8 + [5.1], "better"),  # 2 (1 + 9) / 2^9 = 0.039
        ([5.0] * 9, [5.0] * 9, "noise"),
        ([None] * 6 + [5.0] * 6, [5.0] * 6 + [9.0] * 6, "better"),  # slower, but it arrives
        ([5.0] * 9 + [None], [4.0] * 9 + [None], "better"),
    ],
)
def test_verdict_is_that_of_a_sign_test(incumbent: list[float | None], best: list[float | None], verdict: str):
    assert check(incumbent, best).verdict == verdict


def candidate(trial: int | None, times: list[float | None], value: float) -> Candidate:
    config = PlannerConfig().replace({"costs.q_track": value})
    return Candidate(trial, config, (0.0,), tuple(map(flight, times)), is_complete=True)


INCUMBENT, BEST = candidate(None, [8.0, 8.0, None, None], 5.0), candidate(7, [6.0, 7.0, 6.5, 6.5], 7.5)


def tuning(check: Check | None, **changes: object) -> TuningResult:
    ranges = (ParameterRange("costs.q_track", 1.0, 20.0),)
    candidates = (INCUMBENT, BEST)
    result = TuningResult("s", ranges, ("time",), INCUMBENT.config, candidates, BEST, (BEST,), check, False)
    return dataclasses.replace(result, **changes)  # type: ignore[arg-type]


def test_candidate_that_is_worse_in_fresh_worlds_is_not_chosen():
    for outcome, value in (
        (check([5.0] * 6, [None] * 6), 5.0),
        (check([None] * 6, [5.0] * 6), 7.5),
        (check([None], [5.0]), 7.5),
        (None, 7.5),
    ):
        assert tuning(outcome).chosen.costs.q_track == value


def test_table_shows_incumbent_and_best_and_warns():
    text = tuning(check([None, 8.0, 8.0], [7.0, 7.0, None])).format_table()
    assert [" ".join(line.split()) for line in text.splitlines()[1:5]] == [
        "incumbent 4 2 15 to 85 % 8.00 s ± 0.00 5",
        "best, trial 7 4 4 51 to 100 % 6.50 s ± 0.41 7.5",
        "incumbent, fresh worlds 3 2 21 to 94 % 8.00 s ± 0.00 5",
        "best, fresh worlds 3 2 21 to 94 % 7.00 s ± 0.00 7.5",
    ]
    assert "only the best candidate arrives in 1, only the incumbent in 1; where both arrive, the best is" in text
    front = tuning(None, objectives=("time", "clearance")).format_table()
    assert "mean min clearance [m]" in front and "6.50 s ± 0.41  0.00 ± 0.00" in front
    assert "Warning: the difference is not significant" in text
    assert "Warning: the best candidate is significantly worse" in tuning(check([5.0] * 6, [None] * 6)).format_table()
    assert "Warning" not in tuning(check([None] * 6, [5.0] * 6)).format_table()
    assert "No candidate was better" in tuning(None, best=INCUMBENT).format_table()
    assert "before the check" in tuning(None, interrupted=True).format_table()
    assert "No conclusion" in tuning(None, best=None, candidates=(), front=(), interrupted=True).format_table()


def test_result_is_plain_json():
    content = tuning(check([None], [5.0]), objectives=("time", "smoothness")).to_dict()
    assert content["best"]["objectives"] == {"time": 6.5, "smoothness": 1.0} and content["best"]["costs"] == [0.0]
    assert json.loads(json.dumps(content)) == content
    assert content["chosen"] == {"costs.q_track": 7.5} and content["check"]["verdict"] == "noise"
