"""Ranges of parameters."""

import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.tune import ParameterRange, parse_ranges

CONFIG = PlannerConfig().replace({"costs.q_track": 4.0, "costs.q_speed": 0.0})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("costs.q_track", ParameterRange("costs.q_track", 1.0, 16.0)),
        ("costs.q-track", ParameterRange("costs.q_track", 1.0, 16.0)),
        ("sampling.correlation", ParameterRange("sampling.correlation", 0.2375, 0.99)),  # its bounds
        ("costs.q_speed=0:20", ParameterRange("costs.q_speed", 0.0, 20.0)),
        ("vehicle.gravity=9:9.5", ParameterRange("vehicle.gravity", 9.0, 9.5)),
    ],
)
def test_range_is_explicit_or_follows_from_the_value(text: str, expected: ParameterRange):
    assert parse_ranges([text], CONFIG) == (expected,)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "nothing to tune; name a parameter"),
        (["costs.q_trak"], "unknown parameter 'costs.q_trak' (did you mean 'costs.q_track'?); aero-viz parameters"),
        (["lookahead=1:2"], "did you mean 'anchors.lookahead'?"),
        (["sampling.samples=8:64"], "sampling.samples is structural"),
        (["candidates.previous"], "candidates.previous is structural"),
        (["costs.use_ground"], "costs.use_ground is True, which is not a number"),
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
def test_invalid_ranges_are_refused(texts: list[str], message: str):
    with pytest.raises((UserError, ValueError)) as caught:
        parse_ranges(texts, CONFIG)
    assert message in str(caught.value)


def test_wide_ranges_are_logarithmic_and_values_have_four_digits():
    wide, narrow = ParameterRange("costs.q_track", 1.0, 100.0), ParameterRange("costs.q_track", 1.0, 9.0)
    assert wide.is_logarithmic and not narrow.is_logarithmic
    assert not ParameterRange("costs.q_speed", 0.0, 9.0).is_logarithmic
    assert wide.round(12.34567) == 12.35 and ParameterRange("a", 1.0, 8.00001).round(8.000009) == 8.0
    assert ParameterRange("a", 1.00004, 8.0).round(1.00004) == 1.00004
