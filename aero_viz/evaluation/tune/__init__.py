"""Search for better parameters by flying: Optuna proposes candidates, which fly in the same worlds.

Candidates are proposed in generations, so that a GPU flies many at once. The worlds are divided into rungs. After each,
candidates that are significantly worse than the best one are given up. Candidates are compared by the share of flights
that arrive and, where that is equal, by the mean of the objective. Finally the best candidate and the incumbent fly in
fresh worlds, because the score of a search's winner is optimistic.
"""

from __future__ import annotations

from aero_viz.evaluation.batching import FlightOptions
from aero_viz.evaluation.tune.objectives import Objective
from aero_viz.evaluation.tune.search import SearchOptions, tune
from aero_viz.evaluation.tune.search_space import ParameterRange, parse_ranges
from aero_viz.evaluation.tune.stored_study import StoredStudy
from aero_viz.evaluation.tune.study import Sampler
from aero_viz.evaluation.tune.tuning_result import Candidate, Check, Score, TuningResult

__all__ = [
    "Candidate",
    "Check",
    "FlightOptions",
    "Objective",
    "ParameterRange",
    "Sampler",
    "Score",
    "SearchOptions",
    "StoredStudy",
    "TuningResult",
    "parse_ranges",
    "tune",
]
