"""Searches with a few short flights."""

import dataclasses
import signal
from pathlib import Path
from typing import Any

import optuna
import pytest
from small_source import small_config, small_source

from aero_viz.errors import UserError
from aero_viz.evaluation.tune import FlightOptions, ParameterRange, Score, SearchOptions, TuningResult, tune
from aero_viz.flight import FlightRules
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

CRIPPLED = small_config().replace({"vehicle.speed_limit": 2.0})
"""The planner asks for a fraction of the speed that the drone can fly."""
RANGE = ParameterRange("vehicle.speed_limit", 2.0, 8.0)
SPARSE = LidarModel("sparse", points_per_sweep=500)
QUICK = FlightRules(ticks_per_plan=5)
SHORT = FlightRules(time_limit=0.1)
"""No flight arrives, so that all candidates are equal."""


@pytest.fixture(scope="module")
def poles() -> World:
    world = small_source(goal=7.0).info.world
    assert world is not None
    return world


def search(world: World, *, flights: int = 2, check: int = 1, **options: Any) -> TuningResult:
    names = {field.name for field in dataclasses.fields(SearchOptions)}
    changes = {name: options.pop(name) for name in list(options) if name in names}
    how = dataclasses.replace(SearchOptions(trials=4, generation=4, rungs=1), **changes)
    flight = FlightOptions(lidar=SPARSE, rules=options.pop("rules", QUICK), device=options.pop("device", "cpu"))
    ranges = options.pop("ranges", [RANGE])
    return tune(CRIPPLED, ranges, [world] * flights, [world] * check, search=how, flight=flight, **options)


def test_a_better_value_is_found_and_holds_in_fresh_worlds(poles: World):
    result = search(poles, check=6, seed=1)
    assert result.best and result.best.trial is not None and result.chosen.vehicle.speed_limit > 3.0
    assert result.check is not None and result.check.verdict == "better" and result.check.paired.faster_b == 6
    times = [score.flight_time_s for score in (result.check.incumbent, result.check.best)]
    assert times[0] and times[1] and times[1] < 0.7 * times[0]
    incumbent, *candidates = result.candidates
    assert incumbent.config == CRIPPLED and incumbent.trial is None and len(candidates) == 4
    assert result.front == (result.best,) and not result.interrupted


def test_worse_candidates_are_given_up_after_a_rung(poles: World):
    """The incumbent is good here, and most values of a wide range are bad."""
    good = small_config().replace({"vehicle.speed_limit": 7.0})
    ranges = [ParameterRange("vehicle.speed_limit", 0.5, 7.0)]
    how = SearchOptions(trials=4, generation=4, rungs=2, seed=3)
    flight = FlightOptions(lidar=LidarModel("sparse", points_per_sweep=1000), rules=QUICK)
    result = tune(good, ranges, [poles] * 8, [poles], search=how, flight=flight)
    flown = [len(candidate.flights) for candidate in result.candidates]
    assert flown[0] == 8 and set(flown[1:]) <= {4, 8} and 4 in flown
    given_up = [candidate for candidate in result.candidates if not candidate.is_complete]
    best = Score.from_results(result.candidates[0].flights[:4]).flight_time_s
    times = [candidate.score.flight_time_s for candidate in given_up]
    assert best is not None and all(time is None or time > best for time in times)


def test_results_do_not_depend_on_the_batch_size(poles: World):
    calls: list[tuple[int, int]] = []

    def note(finished: int, total: int, text: str) -> None:
        calls.append((finished, total))

    single, batched, other_seed = (
        search(
            poles, flights=1, seed=seed, batch=batch, rules=dataclasses.replace(QUICK, time_limit=2.5), progress=note
        )
        for seed, batch in ((5, 1), (5, 3), (6, 3))
    )
    assert without_timing(single) == without_timing(batched) != without_timing(other_seed)
    # A flight of the incumbent, four of candidates, and two of the check.
    assert calls[0] == (0, 7) and max(calls) == (7, 7)


def without_timing(result: TuningResult) -> Any:
    strip = [
        (c.trial, c.config, [dataclasses.replace(f, plan_ms_median=None) for f in c.flights]) for c in result.candidates
    ]
    return strip, result.check


def test_the_incumbent_stays_the_best_if_no_candidate_is_better(poles: World):
    result = search(poles, rules=SHORT)
    assert result.best is not None and result.best.trial is None
    assert result.check is None and result.chosen == CRIPPLED
    assert all(candidate.score.arrived == 0 for candidate in result.candidates)


def test_an_incumbent_outside_the_ranges_is_compared_too(poles: World):
    result = search(poles, ranges=[ParameterRange("vehicle.speed_limit", 4.0, 8.0)], trials=2, generation=2)
    assert result.candidates[0].config == CRIPPLED and result.best is not None and result.best.trial is not None


def test_several_objectives_give_a_front_that_no_candidate_dominates(poles: World):
    result = search(poles, objectives=("time", "smoothness"), trials=6, generation=6, seed=2)
    assert len(result.candidates) == 7 and all(candidate.is_complete for candidate in result.candidates)
    for point in result.front:
        assert len(point.values) == 3
        assert not any(
            all(a <= b for a, b in zip(other.values, point.values, strict=True)) and other.values != point.values
            for other in result.candidates
        )
    assert "front, trial" in result.format_table()


@pytest.mark.parametrize("sampler", ["cmaes", "random", "nsga2"])
def test_every_sampler_proposes_candidates_within_the_ranges(poles: World, sampler: str):
    ranges = [RANGE, ParameterRange("costs.q_track", 1.0, 100.0)]
    result = search(poles, ranges=ranges, sampler=sampler, trials=6, generation=3, flights=1, rules=SHORT)
    values = {tuple(result.values(candidate.config).values()) for candidate in result.candidates[1:]}
    assert len(result.candidates) == 7 and len(values) > 2
    assert all(2.0 <= speed <= 8.0 and 1.0 <= q <= 100.0 for speed, q in values)


def test_contradictory_values_are_proposed_again(poles: World):
    ranges = [ParameterRange("costs.distance_min", 0.1, 1.0), ParameterRange("costs.distance_max", 0.1, 1.0)]
    result = search(poles, ranges=ranges, flights=1, rules=SHORT)
    assert len(result.candidates) == 5
    assert all(c.config.costs.distance_min < c.config.costs.distance_max for c in result.candidates)
    with pytest.raises(UserError, match=r"Hardly any values .* must be less than costs\.distance_max"):
        search(poles, ranges=[ParameterRange("costs.distance_min", 2.0, 3.0)], flights=1, rules=SHORT)


def test_a_study_on_disk_is_continued_and_holds_the_same_candidates(poles: World, tmp_path: Path):
    storage = f"sqlite:///{tmp_path}/below/tune.db"
    first = search(poles, rules=SHORT, storage=storage, trials=4)
    flights: list[int] = []
    more = search(
        poles, rules=SHORT, storage=storage, trials=6, progress=lambda done, total, text: flights.append(total)
    )
    assert more.study == first.study and len(more.candidates) == 7 and more.candidates[:5] == first.candidates
    assert flights[0] == 2 * 2 + 2  # two new candidates in two worlds, and the check
    same = search(poles, rules=SHORT, storage=storage, trials=6)
    assert same.candidates == more.candidates


def test_a_study_with_other_options_is_refused(poles: World, tmp_path: Path):
    options: dict[str, Any] = {"storage": f"sqlite:///{tmp_path}/tune.db", "study_name": "mine", "rules": SHORT}
    search(poles, flights=1, **options)
    with pytest.raises(UserError, match=r"'mine' in sqlite:.* was made with other options \(search\)"):
        search(poles, flights=1, seed=9, **options)


@pytest.mark.parametrize(("pressed_at", "candidates"), [(0, 0), (2, 1), (4, 1), (10, 5)])
def test_ctrl_c_keeps_the_candidates_that_have_flown(poles: World, pressed_at: int, candidates: int):
    """The incumbent has two flights, and the generation eight; then comes the check."""

    def press(finished: int, total: int, text: str) -> None:
        if finished == pressed_at and "finished" in text:  # during a flight, not between two batches
            signal.raise_signal(signal.SIGINT)

    result = search(poles, seed=1, batch=1, progress=press)
    assert result.interrupted and result.check is None and len(result.candidates) == candidates
    assert (result.chosen != CRIPPLED) == (candidates == 5)


def test_an_interrupted_study_is_continued(poles: World, tmp_path: Path):
    storage = f"sqlite:///{tmp_path}/tune.db"

    def press(finished: int, total: int, text: str) -> None:
        if finished == 3:
            raise KeyboardInterrupt

    assert search(poles, rules=SHORT, storage=storage, progress=press).interrupted
    result = search(poles, rules=SHORT, storage=storage)
    assert not result.interrupted and len(result.candidates) == 5


@pytest.mark.parametrize("sampler", ["random", "tpe", "cmaes", "nsga2"])
def test_a_continued_study_proposes_what_an_uninterrupted_one_does(poles: World, tmp_path: Path, sampler: str):
    options: dict[str, Any] = {"sampler": sampler, "generation": 3, "flights": 1, "rules": SHORT}
    options["ranges"] = [RANGE, ParameterRange("costs.q_track", 1.0, 100.0)]
    whole = search(poles, trials=6, **options)
    storage = f"sqlite:///{tmp_path}/tune.db"
    search(poles, trials=3, storage=storage, **options)
    continued = search(poles, trials=6, storage=storage, **options)
    assert without_timing(continued) == without_timing(whole)
    assert len({tuple(whole.values(candidate.config).values()) for candidate in whole.candidates}) == 7


def test_the_candidates_of_a_killed_search_are_flown_again(poles: World, tmp_path: Path):
    """Their trials are running for ever in the storage."""
    storage, how = f"sqlite:///{tmp_path}/tune.db", {"sampler": "random", "generation": 2, "rules": SHORT}
    search(poles, trials=2, storage=storage, study_name="killed", **how)
    study = optuna.load_study(study_name="killed", storage=storage)
    study.ask()
    result = search(poles, trials=4, storage=storage, study_name="killed", **how)
    whole = search(poles, trials=4, **how)
    assert [one.config for one in result.candidates] == [one.config for one in whole.candidates]
    assert [trial.number for trial in study.trials if trial.state.name == "FAIL"] == [3]
    assert not [trial for trial in study.trials if trial.state.name == "RUNNING"]


def test_two_searches_in_one_study_are_refused(poles: World, tmp_path: Path):
    options: dict[str, Any] = {"storage": f"sqlite:///{tmp_path}/tune.db", "study_name": "mine", "rules": SHORT}

    def continue_elsewhere(finished: int, total: int, text: str) -> None:
        if finished == 2 and "candidates" in text:  # after the incumbent
            search(poles, **options)

    with pytest.raises(UserError, match="Another command continues the study 'mine'; run one at a time"):
        search(poles, progress=continue_elsewhere, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rungs": 0}, "cannot be divided into 0 rungs"),
        ({"rungs": 3}, "give --rungs 1 to 2, or more --flights"),
        ({"trials": 0}, "--trials and --generation must be at least 1"),
        ({"check": 0}, "--flights, --check and --batch must be at least 1"),
        ({"batch": 0}, "at least 1"),
        ({"device": "cuda:77"}, "'cuda:77' is not available"),
        ({"sampler": "cmaes", "objectives": ("time", "clearance")}, "CMA-ES has one objective only"),
        ({"objectives": ("time", "time")}, "--objective time is given twice"),
        ({"storage": "nonsense://x"}, "Cannot open the storage nonsense://x"),
        ({"storage": "sqlite:////dev/null/below/tune.db"}, "Cannot open the storage sqlite:////dev/null/below/tune.db"),
    ],
)
def test_options_out_of_range_are_refused(poles: World, options: dict[str, Any], message: str):
    with pytest.raises(UserError) as caught:
        search(poles, **options)
    assert message in str(caught.value)
    assert ("Cannot open" in str(caught.value)) == ("storage" in options)


def test_a_world_in_which_no_flight_can_arrive_is_refused_before_the_first_flight(poles: World):
    buried = dataclasses.replace(poles, goal=poles.cylinders[0, :3] + (0.0, 0.0, 2.0))
    with pytest.raises(UserError, match="inside an obstacle"):
        tune(CRIPPLED, [RANGE], [poles] * 3, [buried])
