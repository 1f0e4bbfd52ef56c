"""Search for better parameters by flying: successive halving of a Latin hypercube (Jamieson and Talwalkar 2016).

The search starts with 2^rounds candidates. In each round the remaining candidates and the incumbent fly in further
worlds, the same for all, and the better half of the candidates stays. Candidates are compared by the share of flights
that arrive and, where that is equal, by the mean time of those that do. Finally the best candidate and the incumbent
fly in fresh worlds, because the winner of a search looks better in it than it is.
"""

from __future__ import annotations

from aero_viz.evaluation.tune.search import tune
from aero_viz.evaluation.tune.search_space import ParameterRange, draw_candidates, parse_ranges
from aero_viz.evaluation.tune.tuning_result import Check, Score, TuningResult

__all__ = ["Check", "ParameterRange", "Score", "TuningResult", "draw_candidates", "parse_ranges", "tune"]
