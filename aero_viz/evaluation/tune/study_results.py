"""The candidates of a study, read once from its trials."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from aero_planner.config import DroneConfig
from aero_viz.evaluation.tune.objectives import Objective, flight_cost, front_values
from aero_viz.evaluation.tune.search_space import ParameterRange
from aero_viz.evaluation.tune.study import INCUMBENT, flights_of, load_flights
from aero_viz.evaluation.tune.tuning_result import Candidate
from aero_viz.flight import FlightResult
from aero_viz.planners.registry import config_of_entry

if TYPE_CHECKING:
    import optuna


@dataclass(frozen=True)
class Problem:
    """Definition of a study."""

    incumbent: DroneConfig
    ranges: tuple[ParameterRange, ...]
    """The tuned parameters."""
    objectives: tuple[Objective, ...]
    """Objectives besides arrivals; several give a Pareto front."""

    @classmethod
    def from_definition(cls, definition: Mapping[str, Any]) -> Problem:
        """Return the problem that the definition of a study describes.

        Raises:
            KeyError, TypeError: the definition has another form.
            ValueError: this version has no such parameter, or a value is out of bounds.
        """
        ranges = tuple(ParameterRange(**values) for values in definition["over"])
        return cls(config_of_entry(definition), ranges, tuple(definition["search"]["objectives"]))

    def config_at(self, params: Mapping[str, Any]) -> DroneConfig:
        """Return the configuration with the values of a trial.

        Raises:
            ValueError: the values contradict each other.
        """
        return self.incumbent.replace({r.path: r.round(params[r.path]) for r in self.ranges})

    def costs(self, flights: Mapping[int, FlightResult]) -> dict[int, float]:
        """Return the cost of each flight for a search with a single objective, by index of the world."""
        return {world: flight_cost(flight, self.objectives[0]) for world, flight in flights.items()}

    def values(self, flights: Sequence[FlightResult]) -> list[float]:
        """Return the values that the search minimises."""
        if len(self.objectives) == 1:
            return [statistics.fmean(flight_cost(flight, self.objectives[0]) for flight in flights)]
        return front_values(flights, self.objectives)


@dataclass(frozen=True)
class StudyResults:
    """The candidates of a study at one moment."""

    candidates: tuple[Candidate, ...]
    """The incumbent, if it has flown, and those that have finished; candidates that were given up are among them."""

    @classmethod
    def read(cls, study: optuna.Study, problem: Problem) -> StudyResults:
        """Return the results so far.

        Raises:
            KeyError, TypeError, ValueError: the study was changed by another program.
        """
        flown: list[tuple[int | None, DroneConfig, dict[int, FlightResult]]] = []
        incumbent = study.user_attrs.get(INCUMBENT)
        if incumbent is not None:
            flown.append((None, problem.incumbent, load_flights(incumbent)))
        flown += [(t.number, problem.config_at(t.params), flights_of(t)) for t in finished_trials(study)]
        size = max((len(flights) for _, _, flights in flown), default=0)
        return cls(tuple(_candidate(problem, *one, size=size) for one in flown))

    @property
    def complete(self) -> list[Candidate]:
        """Candidates that flew in all worlds."""
        return [candidate for candidate in self.candidates if candidate.is_complete]

    @property
    def front(self) -> tuple[Candidate, ...]:
        """Pareto front: the complete candidates that no other one beats in every value that the search minimises."""
        return tuple(pareto_front(self.complete, key=lambda candidate: candidate.values))

    @property
    def best(self) -> Candidate | None:
        """The best complete candidate, the incumbent where no other one is better; None before any has flown."""
        return min(self.complete, key=lambda one: (one.values, one.trial is not None), default=None)


def finished_trials(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """Return all trials that have flown, without the incumbent."""
    trials = study.get_trials(deepcopy=False)
    return [t for t in trials if t.state.name in ("COMPLETE", "PRUNED") and not t.user_attrs.get(INCUMBENT)]


def pareto_front(candidates: Sequence[Candidate], *, key: Callable[[Candidate], Sequence[float]]) -> list[Candidate]:
    """Return the candidates that no other one beats: none is as good in all values of `key` and smaller in one."""
    values = [tuple(key(candidate)) for candidate in candidates]
    return [
        candidate
        for candidate, own in zip(candidates, values, strict=True)
        if not any(other != own and all(a <= b for a, b in zip(other, own, strict=True)) for other in values)
    ]


def _candidate(
    problem: Problem, trial: int | None, config: DroneConfig, flights: Mapping[int, FlightResult], *, size: int
) -> Candidate:
    flown = tuple(flights[world] for world in sorted(flights))
    return Candidate(trial, config, tuple(problem.values(flown)), flown, is_complete=len(flown) == size)
