"""A study on disk, as the page shows it: its progress, its candidates, and the importance of each parameter."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from aero_planner.parameters import did_you_mean
from aero_viz.errors import UserError
from aero_viz.evaluation.tune.objectives import UNITS, Objective, front_values, measure
from aero_viz.evaluation.tune.storage import check_file, first_line, read_only_storage, sqlite_file
from aero_viz.evaluation.tune.study import DEFINITION, INCUMBENT, TRIALS, flight_count, require_optuna
from aero_viz.evaluation.tune.study_results import Problem, StudyResults, finished_trials, pareto_front
from aero_viz.evaluation.tune.tuning_result import Candidate
from aero_viz.statistics import mean_interval, wilson_interval
from aero_viz.study_view import Estimate, Importance, StudyPoint, StudyView

if TYPE_CHECKING:
    import optuna

ARRIVED = "arrived [%]"
_LEAST_TRIALS = 8
"""Number of complete candidates from which the importance of parameters is estimated."""
_BEST_SHARE = 0.25
"""Share of the candidates that the importance sets apart from the others."""
_RESAMPLES = 30
_NAMES_MAX = 10


class StoredStudy:
    """A study of `tune` in a storage, read only. Another process may be running it.

    Args:
        storage: URL of Optuna's storage.
        name: name of the study.

    Raises:
        UserError: there is no such storage or study, or it is damaged or was not made by `tune`.
    """

    def __init__(self, storage: str, name: str) -> None:
        optuna = require_optuna()
        path, opened = sqlite_file(storage), storage
        self._start_reading: Callable[[], object] = lambda: None
        if path is not None:
            if not path.exists():
                raise UserError(
                    f"There is no storage {path}; make a study with aero-viz tune, or give another --storage."
                )
            check_file(path)
            opened, self._start_reading = read_only_storage(storage, path)
        try:
            names = optuna.get_all_study_names(opened)
            if name not in names:
                shown = ", ".join(sorted(names)[:_NAMES_MAX]) + (", .." if len(names) > _NAMES_MAX else "")
                raise UserError(
                    f"There is no study {name!r} in {storage}{did_you_mean(name, names)}; "
                    + (f"it holds {shown}." if names else "it holds none. Make one with: aero-viz tune.")
                )
            self._study: optuna.Study = optuna.load_study(study_name=name, storage=opened)
        except UserError:
            raise
        except Exception as error:  # SQLAlchemy and database drivers raise their own exceptions
            raise UserError(f"Cannot read the storage {storage} of Optuna: {first_line(error)}") from error
        self._where = f"The study {name!r} in {storage}"
        self._seen: Any = None
        self._view: StudyView | None = None
        self._importance: tuple[Importance, ...] = ()
        self._importance_trials = 0
        self.read()

    def read(self) -> StudyView:
        """Return the results so far; the same object if nothing has changed.

        Raises:
            UserError: the storage cannot be read any more, or the study is damaged.
        """
        attributes: Mapping[str, Any] = {}
        self._start_reading()
        try:
            attributes = self._study.user_attrs
            trials = self._study.get_trials(deepcopy=False)
            seen = INCUMBENT in attributes, attributes.get(TRIALS), [(t.state, flight_count(t)) for t in trials]
            if self._view is None or seen != self._seen:
                self._view, self._seen = self._read(attributes), seen
            return self._view
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            is_own = DEFINITION in attributes
            what = "is damaged, or of another version" if is_own else "was not made by aero-viz tune"
            raise UserError(
                f"{self._where} {what} ({first_line(error)}); choose another --study, or fly a new one."
            ) from error
        except Exception as error:
            raise UserError(f"{self._where} cannot be read: {first_line(error)}") from error

    def _read(self, attributes: Mapping[str, Any]) -> StudyView:
        problem = Problem.from_definition(attributes[DEFINITION])
        results, finished = StudyResults.read(self._study, problem), finished_trials(self._study)
        size = max((len(candidate.flights) for candidate in results.candidates), default=1)
        begun = [t for t in self._study.get_trials(deepcopy=False) if t.state.name == "RUNNING"]
        asked = max(int(attributes.get(TRIALS, 0)), len(finished))
        flying = sum(map(flight_count, begun[-max(asked - len(finished), 1) :]))
        return StudyView(
            name=self._study.study_name,
            finished=len(finished),
            asked=asked,
            flights=sum(len(candidate.flights) for candidate in results.candidates) + flying,
            progress=min((len(finished) + flying / size) / max(asked, 1), 1.0),
            axes=(ARRIVED, *(_axis(name) for name in problem.objectives)),
            points=_points(results.complete, problem.objectives),
            importance=self._estimate_importance(is_final=len(finished) >= asked),
        )

    def _estimate_importance(self, *, is_final: bool) -> tuple[Importance, ...]:
        """Return the importance of the parameters, estimated anew once there are a tenth more candidates.

        This takes seconds for several hundred candidates, on a machine that may fly at the same time.
        """
        trials = [
            trial
            for trial in self._study.get_trials(deepcopy=False)
            if trial.state.name == "COMPLETE" and all(map(math.isfinite, trial.values))
        ]
        count, before = len(trials), self._importance_trials
        if count >= _LEAST_TRIALS and (count >= 1.1 * before or (is_final and count > before)):
            self._importance = tuple(_importance(trials, self._study.directions))
            self._importance_trials = count
        return self._importance


def _axis(objective: Objective) -> str:
    return f"{objective} [{UNITS[objective]}]"


def _points(complete: Sequence[Candidate], objectives: Sequence[Objective]) -> tuple[StudyPoint, ...]:
    front = pareto_front(complete, key=lambda candidate: front_values(candidate.flights, objectives))
    return tuple(
        StudyPoint(
            one.trial,
            one.config,
            _estimates(one, objectives),
            any(one is best for best in front) and one.score.arrived > 0,
        )
        for one in complete
    )


def _estimates(candidate: Candidate, objectives: Sequence[Objective]) -> dict[str, Estimate]:
    score = candidate.score
    low, high = wilson_interval(score.arrived, score.flights)
    estimates = {ARRIVED: Estimate(100.0 * score.arrived / score.flights, 100.0 * low, 100.0 * high)}
    for objective in objectives:
        values = [measure(flight, objective) for flight in candidate.flights if flight.arrived]
        if values:
            estimates[_axis(objective)] = Estimate(*(mean_interval(values) or (values[0], -math.inf, math.inf)))
    return estimates


def _importance(
    trials: Sequence[optuna.trial.FrozenTrial], directions: Sequence[optuna.study.StudyDirection]
) -> list[Importance]:
    """Return the importance of each parameter by PED-ANOVA, with its spread over resampled candidates."""
    optuna = require_optuna()
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=_BEST_SHARE)

    def shares(chosen: Sequence[optuna.trial.FrozenTrial]) -> dict[str, float]:
        copy = optuna.create_study(directions=directions)
        copy.add_trials(chosen)
        return optuna.importance.get_param_importances(copy, evaluator=evaluator)

    random = np.random.default_rng(0)
    drawn = [shares([trials[i] for i in random.integers(len(trials), size=len(trials))]) for _ in range(_RESAMPLES)]
    importance = []
    for path, share in shares(trials).items():
        low, high = (float(value) for value in np.quantile([one.get(path, 0.0) for one in drawn], (0.05, 0.95)))
        importance.append(Importance(path, share, min(low, share), max(high, share)))
    return importance
