"""A small benchmark with flights of 0.2 s, which tests the runner rather than the planner."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from aero_planner import PlannerConfig
from aero_viz.evaluation.bench import Benchmark, Row, Run, run_benchmark
from aero_viz.flight import FlightRules

CONFIG = PlannerConfig().replace({"sampling.samples": 8, "sampling.steps": 10})


BENCHMARK_OF_THREE = Benchmark(
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
DEFAULTS: dict[str, Any] = {
    "flights": 2,
    "config": CONFIG,
    "sensor": {"points_per_sweep": 500},
    "rules": FlightRules(time_limit=0.2),
    "causes": False,
}


@pytest.fixture
def benchmark_of_three() -> Benchmark:
    """Two rows that fly in one batch, and between them a row with another structure."""
    return BENCHMARK_OF_THREE


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a complete run of the small benchmark."""
    folder = tmp_path_factory.mktemp("flown") / "run"
    run_benchmark(BENCHMARK_OF_THREE, folder, **DEFAULTS)
    return folder


@pytest.fixture
def fly(flown: Path, tmp_path: Path) -> Callable[..., Run]:
    """Return a function that runs the small benchmark and writes the results into a folder with the given name.

    The run without options is flown once for all tests, and copied.
    """

    def run(name: str = "out", benchmark: Benchmark = BENCHMARK_OF_THREE, **options: Any) -> Run:
        folder = tmp_path / name
        is_new = folder.parent.is_dir() and not folder.exists()
        if is_new and benchmark is BENCHMARK_OF_THREE and not options:
            shutil.copytree(flown, folder)
            options = {"resume": True}
        return run_benchmark(benchmark, folder, **(DEFAULTS | options))

    return run
