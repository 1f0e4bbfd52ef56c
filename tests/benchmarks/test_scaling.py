import csv
import json
from pathlib import Path

import pytest

from benchmarks.scaling import Row, main, superlinear


def row(samples: int, milliseconds: float, sweep: str = "M K N") -> Row:
    return Row(sweep, 15, samples, 25, 1, None, milliseconds, milliseconds, milliseconds, None)


def test_superlinear_names_the_sizes_that_cost_more_for_each_state():
    rows = [row(256, 1.9), row(128, 1.0), row(512, 5.0), row(1024, 8.4), row(4096, 99.0, "batch")]
    assert superlinear(rows, "M K N") == [rows[2]]
    assert superlinear(rows, "batch") == []
    assert rows[1].work == 48_000 and rows[1].nanoseconds == pytest.approx(1e6 / 48_000)


def test_run_writes_table_and_plot(device: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arguments = ["--points", "2000", "--repeat", "2", "--largest", "96000", "--batch", "1", "2"]
    assert main([*arguments, "--device", device, "--output", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "M K N: the time grows" in output and "batch: the time grows" in output
    with (tmp_path / "scaling.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["instances"], r["samples"], r["steps"]) for r in rows[:3]] == [
        ("15", "128", "25"), ("15", "256", "25"), ("15", "128", "50")
    ]  # fmt: skip
    assert [r["batch"] for r in rows if r["sweep"] == "batch"] == ["1", "2"]
    about = json.loads((tmp_path / "scaling.json").read_text())
    assert about["device"] == device and len(about["rows"]) == len(rows)
    assert all(r["p99_ms"] >= r["median_ms"] >= r["least_ms"] > 0.0 for r in about["rows"])
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
