"""Finds better parameters by flying: successive halving of a Latin hypercube (Jamieson and Talwalkar 2016).

Of 2^rounds candidates, every round flies those that are left, and the incumbent, through further worlds, the same for
all, and keeps the better half: first by the share of flights that arrive, and where that is equal by the mean time of
those that do. The best and the incumbent then fly fresh worlds, as a winner looks better in its search than it is.
"""

from __future__ import annotations

from aero_viz.evaluation.tune.outcome import Check, Score, Tuning
from aero_viz.evaluation.tune.search import tune
from aero_viz.evaluation.tune.spans import Span, draw, parse_spans

__all__ = ["Check", "Score", "Span", "Tuning", "draw", "parse_spans", "tune"]
