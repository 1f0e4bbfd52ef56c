"""Searches with a few short flights."""

from __future__ import annotations

import dataclasses
import signal
from typing import Any

import pytest
from small_source import small_config, small_source

from aero_viz.errors import UserError
from aero_viz.evaluation.tune import ParameterRange, TuningResult, tune
from aero_viz.flight import FlightRules
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

CRIPPLED = small_config().replace({"anchors.lookahead": 1.0})
"""With a look-ahead of 1 m the planner asks for a seventh of the speed that the drone can fly."""
RANGE = ParameterRange("anchors.lookahead", 1.0, 8.0)


@pytest.fixture(scope="module")
def poles() -> World:
    world = small_source(goal=7.0).info.world
    assert world is not None
    return world


def search(world: World, *, flights: int = 2, check: int = 6, **options: Any) -> TuningResult:
    defaults: dict[str, Any] = {"rounds": 2, "lidar": LidarModel("sparse", points_per_sweep=1000)}
    return tune(CRIPPLED, [RANGE], [world] * flights, [world] * check, **(defaults | options))


def test_finds_a_better_value_that_holds_in_fresh_worlds(poles: World) -> None:
    tuning = search(poles, seed=1)
    assert tuning.best and tuning.chosen.anchors.lookahead > 2.0
    assert tuning.check is not None and tuning.check.verdict == "better" and tuning.check.faster == 6
    times = [score.flight_time_s for score in (tuning.check.incumbent, tuning.check.best)]
    assert times[0] and times[1] and times[1] < 0.7 * times[0]
    # Four candidates fly in one world and the better two in the other one, too. The incumbent flies in both.
    assert tuning.candidates[0] == CRIPPLED and tuning.scores[0].flights == 2
    assert sorted(score.flights for score in tuning.scores[1:]) == [1, 1, 2, 2] and tuning.compared == 2
    assert not tuning.interrupted


def test_results_do_not_depend_on_the_batch_size(poles: World) -> None:
    calls: list[tuple[int, int]] = []

    def note(finished: int, total: int, text: str) -> None:
        calls.append((finished, total))

    single, batched, other_seed = (
        search(poles, flights=3, check=2, seed=seed, batch=batch, rules=FlightRules(time_limit=2.5), progress=note)
        for seed, batch in ((5, 1), (5, 4), (6, 4))
    )
    assert single == batched and single.to_dict() != other_seed.to_dict()
    # Five flights in one world, three in each of two, and two in each of the two worlds of the check.
    assert calls[0] == (0, 15) and (15, 15) in calls and max(calls) == (15, 15)


@pytest.mark.parametrize(("rounds", "total"), [(4, 200), (6, 386)])
def test_number_of_flights_is_the_documented_one(poles: World, rounds: int, total: int) -> None:
    def end(finished: int, reported: int, text: str) -> None:
        assert reported == total
        raise KeyboardInterrupt

    assert search(poles, flights=16, check=32, rounds=rounds, progress=end).interrupted


def test_incumbent_stays_the_best_if_no_candidate_is_better(poles: World) -> None:
    """No flight arrives within 0.1 s: all candidates are equal, and there is nothing to check."""
    tuning = search(poles, rules=FlightRules(time_limit=0.1))
    assert (tuning.best, tuning.check, tuning.compared) == (0, None, 2) and tuning.chosen == CRIPPLED
    assert all(score.arrived == 0 for score in tuning.scores)


@pytest.mark.parametrize(
    ("pressed_at", "compared", "checked"), [(2, 0, False), (7, 1, False), (9, 2, False), (99, 2, True)]
)
def test_ctrl_c_keeps_the_best_candidate_so_far(poles: World, pressed_at: int, compared: int, checked: bool) -> None:
    """The first round has five flights, the second one three; then comes the check."""

    def press(finished: int, total: int, text: str) -> None:
        if finished == pressed_at and "finished" in text:  # during a flight, not between two batches
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
def test_options_out_of_range_are_refused(poles: World, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        search(poles, **options)
    assert message in str(caught.value)


def test_world_in_which_no_flight_can_arrive_is_refused_before_the_first_flight(poles: World) -> None:
    buried = dataclasses.replace(poles, goal=poles.cylinders[0, :3] + (0.0, 0.0, 2.0))
    with pytest.raises(UserError, match="inside an obstacle"):
        tune(CRIPPLED, [RANGE], [poles], [buried], rounds=1)
