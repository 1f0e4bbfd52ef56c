"""The planner once more, as simply as its equations read: the yardstick of results and of speed.

One thread per point, cell, sample or position, no pruning, no tables, no fused stages. It shares configuration,
parameters and sampled noise with `aero_planner`, and no kernel or function. It is not to be made faster.
"""

from __future__ import annotations

from benchmarks.naive.planner import NaivePlanner

__all__ = ["NaivePlanner"]
