"""The Optuna study of a search: its storage, its sampler, and the definition that makes it resumable."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from aero_viz.errors import UserError
from aero_viz.evaluation.tune.objectives import Objective
from aero_viz.evaluation.tune.storage import check_file, first_line, sqlite_file
from aero_viz.extras import from_extra
from aero_viz.flight import FlightResult

if TYPE_CHECKING:
    import optuna

Sampler = Literal["auto", "tpe", "cmaes", "nsga2", "random"]
DEFINITION, INCUMBENT, TRIALS = "definition", "incumbent", "trials"
"""Attributes of a study: what it searches, the flights of the incumbent, and the number of candidates asked for."""
CANDIDATE = "candidate"
"""Attribute of a trial: which candidate of the study it is, counted from 0. A candidate that was not finished is
proposed again, as another trial."""
_FLIGHTS = "flights"
_SMALLEST_POPULATION = 5
"""Smallest population with which CMA-ES works."""
_GIVE_UP_AT = 0.1
"""A candidate is given up if a Wilcoxon signed-rank test says that it is worse than the best one at this level, which
takes at least four worlds."""


def open_study(
    definition: Mapping[str, Any],
    *,
    objectives: Sequence[Objective],
    sampler: Sampler,
    generation: int,
    seed: int,
    storage: str | None = None,
    name: str | None = None,
) -> optuna.Study:
    """Return a new study, or the one that the storage holds under this name.

    Args:
        definition: everything that the flights depend on, as plain values for JSON.
        objectives: one, or several for a Pareto front.
        sampler: algorithm that proposes candidates; "auto" is TPE for one objective and NSGA-II for several.
        generation: number of candidates that are proposed at once.
        seed: seed of the sampler.
        storage: URL of Optuna's storage; None keeps the study in memory.
        name: name of the study; None derives one from the definition.

    Raises:
        UserError: the sampler has one objective only, the storage cannot be opened, or it holds a study of this name
            with another definition.
    """
    optuna = require_optuna()
    made_sampler = make_sampler(sampler, generation=generation, seed=seed, count=len(objectives))
    definition = json.loads(json.dumps(definition))
    digest = hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()[:8]
    pruner = optuna.pruners.WilcoxonPruner(p_threshold=_GIVE_UP_AT)
    path = None if storage is None else sqlite_file(storage)
    if path is not None and path.is_file() and path.stat().st_size:
        check_file(path)
    try:
        if path is not None:
            path.absolute().parent.mkdir(parents=True, exist_ok=True)
        study = optuna.create_study(
            storage=storage,
            sampler=made_sampler,
            pruner=pruner,
            study_name=name or f"{definition['world']}-{digest}",
            directions=[optuna.study.StudyDirection.MINIMIZE] * (len(objectives) + 1 if len(objectives) > 1 else 1),
            load_if_exists=True,
        )
    except Exception as error:  # SQLAlchemy and database drivers raise their own exceptions
        raise UserError(
            f"Cannot open the storage {storage or 'in memory'} of Optuna: {first_line(error)}; "
            "give a URL such as sqlite:///results/tune.db, or memory."
        ) from error
    previous = study.user_attrs.get(DEFINITION)
    if previous is None:
        study.set_user_attr(DEFINITION, definition)
        study.set_metric_names(
            ["not arrived", *objectives] if len(objectives) > 1 else [f"not arrived, {objectives[0]}"]
        )
    elif previous != definition:
        keys = ", ".join(key for key in definition if definition[key] != previous.get(key))
        raise UserError(
            f"The study {study.study_name!r} in {storage} was made with other options ({keys}); "
            "choose another --study, or the same options."
        )
    return study


def require_optuna() -> Any:
    """Return the package Optuna, which reports errors only.

    Raises:
        UserError: it is not installed.
    """
    with from_extra("tune", "Studies"):
        import optuna
    # The pruner and the names of metrics are marked as experimental; constraints.txt pins the version.
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


def make_sampler(name: Sampler, *, generation: int, seed: int, count: int) -> optuna.samplers.BaseSampler:
    """Return a sampler of Optuna.

    Args:
        name: the algorithm; "auto" is TPE for one objective and NSGA-II for several.
        generation: number of candidates that are proposed at once.
        seed: seed of the sampler.
        count: number of objectives.

    Raises:
        UserError: the sampler has one objective only, or needs larger generations.
    """
    from optuna import samplers

    if name == "auto":
        name = "tpe" if count == 1 else "nsga2"
    if name == "nsga2" and generation < 2:
        raise UserError(f"--generation is {generation}, and the sampler {name} proposes at least 2 candidates at once.")
    if name == "cmaes" and count > 1:
        raise UserError("CMA-ES has one objective only; give one --objective, or choose another --sampler.")
    if name == "tpe":
        return samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=generation)
    if name == "cmaes":
        return samplers.CmaEsSampler(
            seed=seed, popsize=max(generation, _SMALLEST_POPULATION), consider_pruned_trials=True
        )
    if name == "nsga2":
        return samplers.NSGAIISampler(seed=seed, population_size=generation)
    return samplers.RandomSampler(seed=seed)


def dump_flights(flights: Mapping[int, FlightResult]) -> dict[str, Any]:
    """Return the results of flights, by index of the world, as plain values for JSON."""
    return {str(world): flight.to_dict() for world, flight in flights.items()}


def load_flights(content: Mapping[str, Any]) -> dict[int, FlightResult]:
    """Return the results of flights, the inverse of `dump_flights`."""
    return {int(world): FlightResult(**values) for world, values in content.items()}


def save_flights(trial: optuna.Trial, flights: Mapping[int, FlightResult]) -> None:
    """Keep the results of a candidate's flights, by index of the world, with its trial."""
    trial.set_user_attr(_FLIGHTS, dump_flights(flights))


def flights_of(trial: optuna.trial.FrozenTrial) -> dict[int, FlightResult]:
    """Return the results of a candidate's flights by index of the world."""
    return load_flights(trial.user_attrs[_FLIGHTS])


def flight_count(trial: optuna.trial.FrozenTrial) -> int:
    """Return the number of a candidate's flights so far."""
    return len(trial.user_attrs.get(_FLIGHTS, ()))
