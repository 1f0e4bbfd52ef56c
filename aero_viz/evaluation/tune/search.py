"""The search: generations of candidates that Optuna proposes, flown through rungs of worlds."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from aero_planner.config import DroneConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.batching import FlightOptions, Progress, check_count, default_batch
from aero_viz.evaluation.executor import Executor, LocalExecutor
from aero_viz.evaluation.machine import versions
from aero_viz.evaluation.tune.candidate_flights import CandidateFlights
from aero_viz.evaluation.tune.objectives import Objective
from aero_viz.evaluation.tune.search_space import ParameterRange
from aero_viz.evaluation.tune.study import (
    CANDIDATE,
    INCUMBENT,
    TRIALS,
    Sampler,
    dump_flights,
    make_sampler,
    open_study,
    save_flights,
)
from aero_viz.evaluation.tune.study_results import Problem, StudyResults, finished_trials
from aero_viz.evaluation.tune.tuning_result import Check, TuningResult
from aero_viz.flight import FlightResult, FlightRules, VehicleModel
from aero_viz.flight.explanation import refuse_impossible
from aero_viz.planners.registry import planner_entry
from aero_viz.scenes import World
from aero_viz.seed_range import check_seed

if TYPE_CHECKING:
    import optuna

_MAX_CONTRADICTIONS = 1000
"""Number of inconsistent proposals in a row before the search gives up."""


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """Options of a search. The results depend on these and on the flights, but not on batches or workers."""

    trials: int = 32
    """Number of candidates besides the incumbent."""
    generation: int = 16
    """Number of candidates that are proposed and flown at once."""
    rungs: int = 3
    """Number of groups of worlds; after each, candidates that are worse than the best one are given up."""
    objectives: tuple[Objective, ...] = ("time",)
    """Objectives besides arrivals. Several give a Pareto front, without giving up candidates."""
    sampler: Sampler = "auto"
    """Algorithm that proposes candidates."""
    seed: int = 0
    """Seed of the sampler and of the flights through the first world."""


def tune(
    config: DroneConfig,
    ranges: Sequence[ParameterRange],
    worlds: Sequence[World],
    fresh_worlds: Sequence[World],
    *,
    search: SearchOptions | None = None,
    flight: FlightOptions | None = None,
    storage: str | None = None,
    study_name: str | None = None,
    batch: int | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    opened: Callable[[str], None] | None = None,
) -> TuningResult:
    """Search for better parameter values by flying. Ctrl-C ends the search; the result is the best so far.

    A study that the storage holds already is continued until it has `search.trials` candidates.

    Args:
        config: the incumbent.
        ranges: parameters to tune.
        worlds: worlds of the search. To fly in one several times, repeat the object.
        fresh_worlds: worlds of the check.
        search: how to search.
        flight: options of all flights.
        storage: URL of Optuna's storage; None keeps the study in memory.
        study_name: name of the study; None derives one from all options.
        batch: largest number of simultaneous flights; None uses `default_batch`.
        executor: flies the batches; None flies one after the other in this process.
        progress: called as flights finish.
        opened: called with the name of the study once the storage holds it, before the first flight.

    Raises:
        UserError: a number is out of range, the ranges contradict each other, no flight can arrive in a world, or the
            storage cannot be used.
        ValueError: an option does not fit the others.
    """
    search, flight = search or SearchOptions(), flight or FlightOptions()
    if flight.vehicle is None:
        flight = dataclasses.replace(flight, vehicle=VehicleModel.from_config(config))
    _check(search, worlds, fresh_worlds, batch)
    limits = [r.high for r in ranges if r.path == "vehicle.speed_limit"]
    for world in {id(world): world for world in (*worlds, *fresh_worlds)}.values():
        refuse_impossible(world, rules=flight.rules or FlightRules(),
                          speed_limit=max([config.vehicle.speed_limit, *limits]))  # fmt: skip
    problem = Problem(config, tuple(ranges), search.objectives)
    study = open_study(
        _definition(problem, worlds, search, flight),
        objectives=search.objectives,
        sampler=search.sampler,
        generation=search.generation,
        seed=search.seed,
        storage=storage,
        name=study_name,
    )
    study.set_user_attr(TRIALS, search.trials)
    if opened is not None:
        opened(study.study_name)
    flights = CandidateFlights(
        (*worlds, *fresh_worlds),
        seed=search.seed,
        options=flight,
        executor=executor or LocalExecutor(),
        size=batch or default_batch(flight.device),
        report=progress or (lambda finished, total, text: None),
    )
    check, interrupted = None, False
    try:
        _Search(study, problem, range(len(worlds)), search, flights).run(check_flights=2 * len(fresh_worlds))
    except KeyboardInterrupt:
        interrupted = True
    results = StudyResults.read(study, problem)
    best = results.best
    if not interrupted and best is not None and best.trial is not None:
        try:
            check = _compare(flights, config, best.config, range(len(worlds), len(worlds) + len(fresh_worlds)))
        except KeyboardInterrupt:
            interrupted = True
    return TuningResult(
        study=study.study_name,
        ranges=problem.ranges,
        objectives=search.objectives,
        incumbent=config,
        candidates=results.candidates,
        best=best,
        front=results.front,
        check=check,
        interrupted=interrupted,
    )


def _check(search: SearchOptions, worlds: Sequence[World], fresh_worlds: Sequence[World], batch: int | None) -> None:
    if search.trials < 1 or search.generation < 1:
        raise UserError("--trials and --generation must be at least 1.")
    check_count("--trials", search.trials)
    if not worlds or not fresh_worlds or (batch is not None and batch < 1):
        raise UserError("--flights, --check and --batch must be at least 1.")
    check_seed(search.seed)
    for i, objective in enumerate(search.objectives):
        if objective in search.objectives[:i]:
            raise UserError(f"--objective {objective} is given twice; leave one out.")
    if not 1 <= search.rungs <= len(worlds):
        possible = "1" if len(worlds) == 1 else f"1 to {len(worlds)}"
        raise UserError(
            f"--flights {len(worlds)} cannot be divided into {search.rungs} rungs, each of at least one flight; give "
            f"--rungs {possible}, or more --flights."
        )


def _definition(
    problem: Problem, worlds: Sequence[World], search: SearchOptions, flight: FlightOptions
) -> dict[str, Any]:
    """Return everything that the flights of a candidate depend on. The number of trials may grow."""
    digest = hashlib.sha256()
    for world in worlds:
        digest.update(json.dumps(world.to_dict()).encode())
    return {
        "world": worlds[0].name,
        "worlds": digest.hexdigest(),
        "over": [dataclasses.asdict(parameter) for parameter in problem.ranges],
        "search": {key: value for key, value in dataclasses.asdict(search).items() if key != "trials"},
        "flight": dataclasses.asdict(flight),
        **planner_entry(problem.incumbent),
        "config": problem.incumbent.to_dict(),
        "versions": versions(),
    }


def _compare(flights: CandidateFlights, incumbent: DroneConfig, best: DroneConfig, worlds: Sequence[int]) -> Check:
    results = flights.fly([incumbent, best], worlds, "fresh worlds")
    return Check.from_results([results[0, w] for w in worlds], [results[1, w] for w in worlds])


class _Search:
    """One run of the search over a study.

    Args:
        study: finished candidates, and the sampler of new ones.
        problem: the incumbent, the parameters and the objectives.
        worlds: indices of the worlds.
        options: how to search.
        flights: flies candidates.
    """

    def __init__(
        self,
        study: optuna.Study,
        problem: Problem,
        worlds: Sequence[int],
        options: SearchOptions,
        flights: CandidateFlights,
    ) -> None:
        self._study, self._problem, self._worlds = study, problem, worlds
        self._options, self._flights = options, flights
        self._single = len(options.objectives) == 1
        self._distributions = {parameter.path: _distribution(parameter) for parameter in problem.ranges}

    def run(self, *, check_flights: int) -> None:
        """Fly the incumbent and generations of candidates until the study has all trials.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed. Candidates of the generation in flight are marked as failed.
        """
        has_incumbent = INCUMBENT in self._study.user_attrs
        size = len(self._worlds)
        self._abandon(t.number for t in self._study.get_trials(deepcopy=False) if t.state.name == "RUNNING")
        self._flights.total = len(self._missing()) * size + check_flights + size * (not has_incumbent)
        if not has_incumbent:
            self._fly_incumbent()
        while missing := self._missing():
            self._fly_generation(missing[: self._options.generation])

    def _missing(self) -> list[int]:
        """Return the candidates that are not finished, counted from 0."""
        finished = finished_trials(self._study)
        done = {trial.user_attrs.get(CANDIDATE, i) for i, trial in enumerate(finished)}
        missing = (i for i in range(self._options.trials + len(finished)) if i not in done)
        return list(islice(missing, max(self._options.trials - len(finished), 0)))

    def _fly_incumbent(self) -> None:
        """Fly the incumbent. If it lies within the ranges, the sampler and the pruner learn of it."""
        import optuna

        config, ranges = self._problem.incumbent, self._problem.ranges
        flown = self._flights.fly([config], self._worlds, "incumbent")
        flights = {w: flown[0, w] for w in self._worlds}
        self._study.set_user_attr(INCUMBENT, dump_flights(flights))
        params = {r.path: float(config.get(r.path)) for r in ranges}
        if all(r.low <= params[r.path] <= r.high for r in ranges):
            trial = optuna.trial.create_trial(
                values=self._problem.values(list(flights.values())),
                params=params,
                distributions=dict(self._distributions),
                intermediate_values=self._problem.costs(flights) if self._single else {},
                user_attrs={INCUMBENT: True},
            )
            self._study.add_trial(trial)

    def _fly_generation(self, candidates: Sequence[int]) -> None:
        import optuna

        remaining = dict(map(self._propose, candidates))
        flights: dict[optuna.Trial, dict[int, FlightResult]] = {trial: {} for trial in remaining}
        ends = [len(self._worlds) * k // self._options.rungs for k in range(self._options.rungs + 1)]
        try:
            for start, end in pairwise(ends):
                trials, worlds = list(remaining), self._worlds[start:end]
                flown = self._flights.fly(list(remaining.values()), worlds, f"{len(trials)} candidates")
                for index, trial in enumerate(trials):
                    flights[trial].update((w, flown[index, w]) for w in worlds)
                    save_flights(trial, flights[trial])
                    if self._single and self._is_given_up(trial, flights[trial], worlds):
                        self._flights.total -= len(self._worlds) - end
                        remaining.pop(trial)
            for trial in remaining:
                self._study.tell(trial, self._problem.values(list(flights.pop(trial).values())))
        except optuna.exceptions.UpdateFinishedTrialError as error:
            raise UserError(
                f"Another command continues the study {self._study.study_name!r}; run one at a time, or choose another "
                "--study."
            ) from error
        except BaseException:
            self._abandon(trial for trial in flights if trial in remaining)
            raise

    def _is_given_up(self, trial: optuna.Trial, flights: dict[int, FlightResult], worlds: Sequence[int]) -> bool:
        """Report the flights of a rung to Optuna; end the trial if it is worse than the best one."""
        import optuna

        for world, cost in self._problem.costs({w: flights[w] for w in worlds}).items():
            trial.report(cost, world)
        if len(flights) == len(self._worlds) or not trial.should_prune():
            return False
        self._study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        return True

    def _abandon(self, trials: Iterator[optuna.Trial | int]) -> None:
        """Mark trials as failed; their candidates are proposed again."""
        import optuna

        for trial in trials:
            with suppress(Exception):  # the first error is the one to report
                self._study.tell(trial, state=optuna.trial.TrialState.FAIL)

    def _propose(self, candidate: int) -> tuple[optuna.Trial, DroneConfig]:
        """Return a trial and its configuration. Values that contradict each other are proposed again.

        The sampler has a seed of its own for each candidate, so that a study that is continued goes on like one that
        was not interrupted.
        """
        import optuna

        options, contradiction = self._options, None
        for attempt in range(_MAX_CONTRADICTIONS):
            seed = int(np.random.SeedSequence([options.seed, candidate, attempt]).generate_state(1)[0])
            self._study.sampler = make_sampler(
                options.sampler, generation=options.generation, seed=seed, count=len(options.objectives)
            )
            trial = self._study.ask(dict(self._distributions))
            trial.set_user_attr(CANDIDATE, candidate)
            try:
                return trial, self._problem.config_at(trial.params)
            except ValueError as error:
                self._study.tell(trial, state=optuna.trial.TrialState.FAIL)
                contradiction = error
        raise UserError(
            f"Hardly any values in the ranges are consistent: {contradiction} Choose ranges that fit each other."
        ) from contradiction


def _distribution(parameter: ParameterRange) -> optuna.distributions.FloatDistribution:
    from optuna.distributions import FloatDistribution

    return FloatDistribution(parameter.low, parameter.high, log=parameter.is_logarithmic)
