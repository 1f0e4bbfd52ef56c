"""Every cost term, and their sums S1 and S2.

`terms` lists those that ship. A stage can bring others, and so can anybody: see `examples/own_cost_term.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_planner.costs.cost_term import CostTerm, End, Step

__all__ = ["CostTerm", "End", "Step"]

__getattr__, __dir__ = lazy_exports(__name__, {"cost_term": ("CostTerm", "End", "Step")})
