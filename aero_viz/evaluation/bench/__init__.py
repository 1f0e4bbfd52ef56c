"""Benchmarks: many flights in many worlds, their statistics, and a report."""

from __future__ import annotations

from aero_viz.evaluation.bench.runner import Run, run_benchmark
from aero_viz.evaluation.bench.suites import BENCHMARKS, Benchmark, Row

__all__ = ["BENCHMARKS", "Benchmark", "Row", "Run", "run_benchmark"]
