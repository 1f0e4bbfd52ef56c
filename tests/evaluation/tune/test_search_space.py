"""Ranges, and the candidates drawn from them."""

from __future__ import annotations

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.tune import ParameterRange, draw_candidates, parse_ranges

CONFIG = PlannerConfig().replace({"costs.q_track": 4.0, "costs.q_speed": 0.0})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("costs.q_track", ParameterRange("costs.q_track", 1.0, 16.0)),
        ("costs.q-track", ParameterRange("costs.q_track", 1.0, 16.0)),
        (
            "sampling.correlation",
            ParameterRange("sampling.correlation", 0.2, 0.99),
        ),  # its bounds
        ("costs.q_speed=0:20", ParameterRange("costs.q_speed", 0.0, 20.0)),
        ("vehicle.gravity=9:9.5", ParameterRange("vehicle.gravity", 9.0, 9.5)),
    ],
)
def test_range_is_explicit_or_follows_from_the_value(text: str, expected: ParameterRange) -> None:
    assert parse_ranges([text], CONFIG) == (expected,)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "nothing to tune; name a parameter"),
        (["costs.q_trak"], "unknown parameter 'costs.q_trak' (did you mean 'costs.q_track'?)"),
        (["lookahead=1:2"], "did you mean 'anchors.lookahead'?"),
        (["sampling.samples=8:64"], "sampling.samples is structural"),
        (["candidates.brake"], "candidates.brake is structural"),
        (["anchors.refine"], "anchors.refine is True, which is not a number"),
        (["costs.shape"], "'quadratic', which is not a number"),
        (["costs.q_track=5"], "write costs.q_track=LOW:HIGH"),
        (["costs.q_track=1:2:3"], "write costs.q_track=LOW:HIGH"),
        (["costs.q_track=5:5"], "empty range"),
        (["costs.q_track=1:2000"], "costs.q_track is 2000.0; it must be a number in [0, 1000]"),
        (["costs.q_track=nan:2"], "costs.q_track is nan"),
        (["costs.q_speed"], "costs.q_speed is 0, which suggests no range"),
        (["costs.q_track", "costs.q-track=1:2"], "costs.q_track is named twice"),
    ],
)
def test_invalid_ranges_are_refused(texts: list[str], message: str) -> None:
    with pytest.raises((UserError, ValueError)) as caught:
        parse_ranges(texts, CONFIG)
    assert message in str(caught.value)


def test_wide_ranges_are_logarithmic_and_narrow_ones_linear() -> None:
    wide, narrow = ParameterRange("costs.q_track", 1.0, 100.0), ParameterRange("costs.q_track", 1.0, 9.0)
    assert [wide.value_at(share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 10.0, 100.0])
    assert [narrow.value_at(share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 5.0, 9.0])
    assert wide.value_at(0.123456) == float(f"{100.0**0.123456:.4g}")


def test_candidates_are_a_reproducible_latin_hypercube() -> None:
    ranges = [ParameterRange("costs.q_track", 0.0, 8.0), ParameterRange("anchors.spacing", 10.0, 18.0)]
    drawn = draw_candidates(CONFIG, ranges, 8, seed=3)
    for parameter in ranges:
        values = np.array([float(candidate.get(parameter.path)) for candidate in drawn])
        eighths = (values - parameter.low).astype(int)
        np.testing.assert_array_equal(np.sort(eighths), np.arange(8))
    assert drawn == draw_candidates(CONFIG, ranges, 8, seed=3) != draw_candidates(CONFIG, ranges, 8, seed=4)
    incumbent = {parameter.path: CONFIG.get(parameter.path) for parameter in ranges}
    assert all(candidate.replace(incumbent) == CONFIG for candidate in drawn)


def test_contradictory_values_are_drawn_again() -> None:
    ranges = [ParameterRange("costs.distance_min", 0.1, 1.0), ParameterRange("costs.distance_max", 0.1, 1.0)]
    drawn = draw_candidates(CONFIG, ranges, 16, seed=0)
    assert len(drawn) == 16 and all(candidate.costs.distance_min < candidate.costs.distance_max for candidate in drawn)
    with pytest.raises(UserError, match=r"Hardly any values .* must be less than costs\.distance_max, which is 0\.55"):
        draw_candidates(CONFIG, [ParameterRange("costs.distance_min", 2.0, 3.0)], 4, seed=0)
