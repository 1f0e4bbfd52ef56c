"""The comparison of two runs of a benchmark."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import run, run_json, run_refused

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.bench import Run
from aero_viz.evaluation.bench.comparison import compare_runs
from aero_viz.flight import FlightRules

SLOWER = PlannerConfig().replace({"sampling.samples": 8, "sampling.steps": 10, "costs.q_track": 1.0})


def write_run(folder: Path, times: list[float | None], **changes: object) -> Path:
    """Write a run with one flight per time [s]; None is a collision."""
    header = {"benchmark": "b", "seed": 0, "lidar": None, "simulation": {}, "config": {"costs": {"q": 1.0}},
              "versions": {"numpy": "1"}, "device": "cpu"} | changes  # fmt: skip
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps(header))
    lines = [
        json.dumps({"row": "r", "index": i, "world_seed": i, "arrived": t is not None, "flight_time_s": t or 1.0})
        for i, t in enumerate(times)
    ]
    (folder / "flights.jsonl").write_text("\n".join(lines) + "\n")
    return folder


def test_two_configurations_are_compared_world_by_world(
    fly: Callable[..., Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    fly("a")
    fly("b", config=SLOWER)
    content = run_json(capsys, "bench", "compare", str(tmp_path / "a"), str(tmp_path / "b"))
    assert list(content["rows"]) == ["slow", "fast", "few samples", "all"] and content["rows"]["all"]["pairs"] == 6
    assert list(content["differences"]) == ["costs.q_track"] and content["unpaired"] == 0
    assert content["rows"]["all"]["verdict"] == "noise"
    code, text, _ = run(capsys, "bench", "compare", str(tmp_path / "a"), str(tmp_path / "a"))
    assert code == 0 and text.startswith("A and B do not differ.")


def test_the_sign_test_decides_by_arrivals_and_then_by_time(tmp_path: Path):
    a = write_run(tmp_path / "a", [None] * 6 + [5.0] * 6)
    arrives_more = write_run(tmp_path / "b", [9.0] * 12, config={"costs": {"q": 2.0}})
    faster = write_run(tmp_path / "c", [None] * 6 + [4.0] * 6)
    comparison = compare_runs(a, arrives_more)
    paired = comparison.rows["r"]
    assert (paired.only_a, paired.only_b, paired.verdict) == (0, 6, "B") and paired.p_arrival == pytest.approx(2 / 2**6)
    assert comparison.differences == {"costs.q": (1.0, 2.0)} and "costs.q: A 1.0, B 2.0" in comparison.format_table()
    assert compare_runs(a, faster).rows["r"].verdict == "B" and compare_runs(faster, a).rows["r"].verdict == "A"


def test_a_world_that_is_flown_several_times_counts_once(tmp_path: Path):
    """Six flights through two worlds from files."""
    rows = [{"label": label, "sha256": "0" * 64} for label in ("a.json", "b.json")]
    times = [5.0, 5.0, 6.0, None, 5.0, 5.0]
    runs = [write_run(tmp_path / name, values, rows=rows) for name, values in (("a", times), ("b", [None, *times[1:]]))]
    for folder in runs:
        lines = [json.loads(line) for line in (folder / "flights.jsonl").read_text().splitlines()]
        lines = [{**flight, "row": rows[i // 3]["label"], "index": i % 3} for i, flight in enumerate(lines)]
        (folder / "flights.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    comparison = compare_runs(*runs)
    paired = comparison.rows["all"]
    assert (paired.pairs, paired.flights, paired.arrived_a, paired.arrived_b) == (2, 6, 5, 4)
    assert (paired.only_a, paired.only_b, paired.faster_a, paired.faster_b) == (1, 0, 0, 0)
    assert paired.slower_by_s is not None and paired.slower_by_s[0] == 0.0
    assert "Worlds are flown several times" in comparison.format_table()


def test_parameters_that_every_row_sets_do_not_differ(tmp_path: Path):
    def write(name: str, speed: float, use_ground: bool, low: float) -> Path:
        config = {"vehicle": {"speed_limit": speed}, "costs": {"use_ground": use_ground, "q": low}}
        labels = ("r", "s")
        changes = ({"costs.use_ground": True}, {"costs.use_ground": True, "costs.q": 1.0})
        rows = [
            {"label": label, "speed": low, "preset": None, "changes": changed}
            for label, changed in zip(labels, changes, strict=True)
        ]
        return write_run(tmp_path / name, [5.0], config=config, rows=rows)

    comparison = compare_runs(write("a", 7.0, True, 2.0), write("b", 50.0, False, 3.0))
    speeds = {"rows.r.speed": (2.0, 3.0), "rows.s.speed": (2.0, 3.0)}
    assert comparison.differences == {"costs.q": (2.0, 3.0), **speeds}


def test_only_flights_that_both_runs_have_are_compared(tmp_path: Path):
    a, b = write_run(tmp_path / "a", [5.0] * 4), write_run(tmp_path / "b", [5.0] * 6)
    comparison = compare_runs(a, b)
    assert comparison.rows["r"].pairs == 4 and comparison.unpaired == 2
    assert "2 flights were left out" in comparison.format_table()


def test_runs_that_do_not_fit_are_refused(fly: Callable[..., Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    fly("a", flights=1)
    fly("b", flights=1, rules=FlightRules(time_limit=0.1))
    with pytest.raises(UserError, match="cannot be compared: simulation is"):
        compare_runs(tmp_path / "a", tmp_path / "b")
    error = run_refused(capsys, "bench", "compare", str(tmp_path / "a"), str(tmp_path / "none"))
    assert "none holds no results; give a folder that `aero-viz bench` wrote" in error
