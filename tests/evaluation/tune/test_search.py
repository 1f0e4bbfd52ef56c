"""Searches of a few short flights."""

from __future__ import annotations

import dataclasses
import signal
from typing import Any

import pytest
from small_source import small_config, small_source

from aero_viz.errors import UserError
from aero_viz.evaluation.tune import Span, Tuning, tune
from aero_viz.flight import FlightRules
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

CRIPPLED = small_config().replace({"anchors.lookahead": 1.0})
"""It asks for a seventh of the speed that the drone is capable of."""
SPAN = Span("anchors.lookahead", 1.0, 8.0)


@pytest.fixture(scope="module")
def poles() -> World:
    world = small_source(goal=7.0).info.world
    assert world is not None
    return world


def search(world: World, *, flights: int = 2, check: int = 6, **options: Any) -> Tuning:
    defaults: dict[str, Any] = {"rounds": 2, "lidar": LidarModel("sparse", points_per_sweep=1000)}
    return tune(CRIPPLED, [SPAN], [world] * flights, [world] * check, **(defaults | options))


def test_a_planted_better_value_is_found_and_holds_in_fresh_worlds(poles: World) -> None:
    tuning = search(poles, seed=1)
    assert tuning.best and tuning.chosen.anchors.lookahead > 2.0
    assert tuning.check is not None and tuning.check.verdict == "better" and tuning.check.faster == 6
    times = [score.flight_time_s for score in (tuning.check.incumbent, tuning.check.best)]
    assert times[0] and times[1] and times[1] < 0.7 * times[0]
    # Four candidates fly one world each, the better two the other as well; the incumbent flies all.
    assert tuning.candidates[0] == CRIPPLED and tuning.scores[0].flights == 2
    assert sorted(score.flights for score in tuning.scores[1:]) == [1, 1, 2, 2] and tuning.compared == 2
    assert not tuning.interrupted


def test_batches_of_any_size_give_the_same_results(poles: World) -> None:
    told: list[tuple[int, int]] = []

    def note(over: int, total: int, text: str) -> None:
        told.append((over, total))

    one, many, other = (
        search(poles, flights=3, check=2, seed=seed, batch=batch, rules=FlightRules(time_limit=2.5), progress=note)
        for seed, batch in ((5, 1), (5, 4), (6, 4))
    )
    assert one == many and one.to_dict() != other.to_dict()
    # One world of four candidates and the incumbent, two of two, and the check of two.
    assert told[0] == (0, 15) and (15, 15) in told and max(told) == (15, 15)


@pytest.mark.parametrize(("rounds", "total"), [(4, 200), (6, 386)])
def test_there_are_as_many_flights_as_the_documentation_says(poles: World, rounds: int, total: int) -> None:
    def end(over: int, whole: int, text: str) -> None:
        assert whole == total
        raise KeyboardInterrupt

    assert search(poles, flights=16, check=32, rounds=rounds, progress=end).interrupted


def test_the_incumbent_stays_the_best_where_nothing_is_better(poles: World) -> None:
    """Nobody arrives in a tenth of a second: all are equal, and there is nothing to check."""
    tuning = search(poles, rules=FlightRules(time_limit=0.1))
    assert (tuning.best, tuning.check, tuning.compared) == (0, None, 2) and tuning.chosen == CRIPPLED
    assert all(score.arrived == 0 for score in tuning.scores)


@pytest.mark.parametrize(
    ("pressed_at", "compared", "checked"), [(2, 0, False), (7, 1, False), (9, 2, False), (99, 2, True)]
)
def test_ctrl_c_keeps_the_best_so_far(poles: World, pressed_at: int, compared: int, checked: bool) -> None:
    """Five flights of the first round, three of the second, then the check."""

    def press(over: int, total: int, text: str) -> None:
        if over == pressed_at and "over" in text:  # in the air, not between two batches
            signal.raise_signal(signal.SIGINT)

    tuning = search(poles, seed=1, batch=1, check=1, progress=press)
    assert (tuning.compared, tuning.interrupted, tuning.check is not None) == (compared, not checked, checked)
    assert bool(tuning.best) == (compared > 0)
    assert compared == 0 or tuning.chosen.anchors.lookahead > 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rounds": 0}, "The number of rounds is 0; it must be in [1, 10]"),
        ({"rounds": 11}, "it must be in [1, 10]"),
        ({"rounds": 3}, "2 flights are fewer than 3 rounds"),
        ({"check": 0}, "at least 1"),
        ({"batch": 0}, "at least 1"),
        ({"device": "cuda:77"}, "'cuda:77' is not available"),
    ],
)
def test_what_cannot_be_searched_is_told(poles: World, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        search(poles, **options)
    assert message in str(caught.value)


def test_a_world_in_which_nobody_can_arrive_is_refused_before_the_first_flight(poles: World) -> None:
    buried = dataclasses.replace(poles, goal=poles.cylinders[0, :3] + (0.0, 0.0, 2.0))
    with pytest.raises(UserError, match="inside an obstacle"):
        tune(CRIPPLED, [SPAN], [poles], [buried], rounds=1)
