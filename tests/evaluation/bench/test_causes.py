"""Causes of the failures of a benchmark."""

from aero_planner import PlannerConfig
from aero_viz.evaluation.bench.causes import cause_of, cause_rows
from aero_viz.evaluation.bench.report import format_causes, write_report
from aero_viz.evaluation.bench.runner import run_benchmark
from aero_viz.evaluation.bench.suites import Benchmark, Row
from aero_viz.scenes import scene

OPEN_ABOVE = {
    "stages.active": "moving_obstacles, way_out, stop_proof, disturbance, memory",
    "costs.height_max": 99.0,
}


def test_failures_are_explained_in_records_and_report(tmp_path):
    row = Row("trap", "double_wall_trap", changes=OPEN_ABOVE)
    run = run_benchmark(Benchmark("trap", "Trap", "A trap.", (row,)), tmp_path, flights=1)
    (flight,) = run.flights
    assert flight["reason"] == "collision" and flight["obstacle"] == "box 7"
    assert flight["cause"].endswith(": outside the field of view")
    assert cause_rows(run.flights) == [(flight["cause"], 1, "trap 0")]
    write_report(run, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "## Causes of failures" in text and flight["cause"] in text and flight["cause"] in format_causes(run)
    assert "cause" in (tmp_path / "flights.csv").read_text().splitlines()[0]


def test_a_failure_that_is_not_repeated_says_so():
    world = scene("double_wall_trap", seed=0)
    cause = cause_of(world, "stall", seed=0, config=PlannerConfig().replace(OPEN_ABOVE))
    assert cause == {"cause": "stall; not repeated when flown alone", "obstacle": None}


def test_causes_are_counted_and_the_most_frequent_comes_first():
    flights = [{"row": "a", "world_seed": seed, "cause": "x" if seed else "y"} for seed in range(5)]
    assert cause_rows([*flights, {"row": "b", "world_seed": 9}]) == [("x", 4, "a 1, a 2, a 3"), ("y", 1, "a 0")]
