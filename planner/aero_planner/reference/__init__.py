"""The AERO-MPPI paper as plain Warp launches, one after another; docs/planner.md goes through it.

Every equation is one function, in the module of its stage. There is no pruning, no table and no tuning, and nothing
that the paper does not have. `aero_planner.Planner` with the preset "paper" is tested against it. Do not make it
faster.
"""

from __future__ import annotations

from aero_planner.reference.planner import ReferencePlanner

__all__ = ["ReferencePlanner"]
