"""What is tried, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.tune import Span, draw, parse_spans

CONFIG = PlannerConfig().replace({"costs.q_track": 4.0, "costs.q_speed": 0.0})


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("costs.q_track", Span("costs.q_track", 1.0, 16.0)),
        ("costs.q-track", Span("costs.q_track", 1.0, 16.0)),
        ("sampling.correlation", Span("sampling.correlation", 0.2, 0.99)),  # never beyond the parameter's bounds
        ("costs.q_speed=0:20", Span("costs.q_speed", 0.0, 20.0)),
        ("vehicle.gravity=9:9.5", Span("vehicle.gravity", 9.0, 9.5)),
    ],
)
def test_a_range_is_given_or_follows_from_the_value(text: str, span: Span) -> None:
    assert parse_spans([text], CONFIG) == (span,)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "nothing to tune; give --over"),
        (["costs.q_trak"], "unknown parameter 'costs.q_trak' (did you mean 'costs.q_track'?)"),
        (["lookahead=1:2"], "did you mean 'anchors.lookahead'?"),
        (["sampling.samples=8:64"], "sampling.samples is structural"),
        (["candidates.brake"], "candidates.brake is structural"),
        (["anchors.refine"], "anchors.refine is True, which is no number"),
        (["costs.shape"], "'quadratic', which is no number"),
        (["costs.q_track=5"], "write costs.q_track=LOW:HIGH"),
        (["costs.q_track=1:2:3"], "write costs.q_track=LOW:HIGH"),
        (["costs.q_track=5:5"], "empty range"),
        (["costs.q_track=1:2000"], "costs.q_track is 2000.0; it must be a number in [0, 1000]"),
        (["costs.q_track=nan:2"], "costs.q_track is nan"),
        (["costs.q_speed"], "costs.q_speed is 0, which suggests no range"),
        (["costs.q_track", "costs.q-track=1:2"], "costs.q_track is given twice"),
    ],
)
def test_what_cannot_be_tuned_is_told(texts: list[str], message: str) -> None:
    with pytest.raises((UserError, ValueError)) as caught:
        parse_spans(texts, CONFIG)
    assert message in str(caught.value)


def test_wide_ranges_are_tried_by_ratio_and_narrow_ones_evenly() -> None:
    wide, narrow = Span("costs.q_track", 1.0, 100.0), Span("costs.q_track", 1.0, 9.0)
    assert [wide.at(share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 10.0, 100.0])
    assert [narrow.at(share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 5.0, 9.0])
    assert wide.at(0.123456) == float(f"{100.0**0.123456:.4g}")


def test_candidates_are_a_latin_hypercube_that_the_seed_fixes() -> None:
    spans = [Span("costs.q_track", 0.0, 8.0), Span("anchors.spacing", 10.0, 18.0)]
    drawn = draw(CONFIG, spans, 8, seed=3)
    for span in spans:
        values = np.array([float(one.get(span.path)) for one in drawn])
        np.testing.assert_array_equal(np.sort((values - span.low).astype(int)), np.arange(8))  # one in each eighth
    assert drawn == draw(CONFIG, spans, 8, seed=3) != draw(CONFIG, spans, 8, seed=4)
    assert all(one.replace({span.path: CONFIG.get(span.path) for span in spans}) == CONFIG for one in drawn)


def test_values_that_contradict_each_other_are_drawn_anew() -> None:
    spans = [Span("costs.distance_min", 0.1, 1.0), Span("costs.distance_max", 0.1, 1.0)]
    drawn = draw(CONFIG, spans, 16, seed=0)
    assert len(drawn) == 16 and all(one.costs.distance_min < one.costs.distance_max for one in drawn)
    with pytest.raises(UserError, match=r"Hardly any values .* must be less than costs\.distance_max, which is 0\.55"):
        draw(CONFIG, [Span("costs.distance_min", 2.0, 3.0)], 4, seed=0)
