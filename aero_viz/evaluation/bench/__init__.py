"""Benchmarks: many flights in many worlds, the statistics of them, and a report."""

from __future__ import annotations

from aero_viz.evaluation.bench.catalog import BENCHMARKS, Benchmark, Row
from aero_viz.evaluation.bench.runner import Run, run_benchmark

__all__ = ["BENCHMARKS", "Benchmark", "Row", "Run", "run_benchmark"]
