"""Naive reference implementation of the planner, to check its results and its speed.

It has one thread per point, cell, sample or position, and no pruning, tables or fused stages. It shares configuration,
parameters and sampled noise with `aero_planner`, but no kernel and no function. Do not make it faster.
"""

from __future__ import annotations

from benchmarks.naive.planner import NEUTRAL, NaivePlanner

__all__ = ["NEUTRAL", "NaivePlanner"]
