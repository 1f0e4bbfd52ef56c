"""A small benchmark with flights of 0.2 s, which tests the runner rather than the planner."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aero_planner import PlannerConfig
from aero_viz.evaluation.bench import Benchmark, Row, Run, run_benchmark
from aero_viz.flight import FlightRules

CONFIG = PlannerConfig().replace({"sampling.samples": 8, "sampling.steps": 10})


@pytest.fixture
def benchmark_of_three() -> Benchmark:
    """Two rows that fly in one batch, and between them a row with another structure."""
    return Benchmark(
        "small",
        "A small benchmark",
        "For tests.",
        (
            Row("slow", "forest", 4, speed=2.0, series="a", x=2.0, published="forest", target=(0.5, 1.0)),
            Row("few samples", "forest", 4, changes={"sampling.samples": 4}, series="a", x=4.0),
            Row("fast", "verticals", 5, speed=7.0, series="b", x=7.0, arrival_radius=1.0),
        ),
        x_label="velocity limit [m/s]",
        first_seed=100,
    )


@pytest.fixture
def fly(benchmark_of_three: Benchmark, tmp_path: Path) -> Callable[..., Run]:
    """Return a function that runs the small benchmark and writes the results into a folder with the given name."""

    def run(name: str = "out", benchmark: Benchmark = benchmark_of_three, **options: Any) -> Run:
        defaults: dict[str, Any] = {
            "flights": 2,
            "config": CONFIG,
            "sensor": {"points_per_sweep": 500},
            "rules": FlightRules(time_limit=0.2),
        }
        return run_benchmark(benchmark, tmp_path / name, **(defaults | options))

    return run
