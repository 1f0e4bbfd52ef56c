import json

import pytest

from aero_planner.benchmark import main

FAST = ["--points", "5000", "--samples", "8", "--steps", "10", "--repeat", "3"]


@pytest.mark.parametrize("batch", [1, 2])
def test_json_report(device: str, batch: int, capsys: pytest.CaptureFixture[str]):
    assert main([*FAST, "--device", device, "--batch", str(batch), "--preset", "paper", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    expected = {"device": device, "batch": batch, "points": 5000, "samples": 8, "steps": 10, "instances": 15}
    assert {name: report[name] for name in expected} == expected and report["preset"] == "paper"
    assert 100 < report["points_kept"] < 5000
    with_sweeps = [report[name] for name in ("sweeps", "sweeps, inputs", "new sweep", "new sweep, inputs")]
    assert (with_sweeps == 4 * [None]) == (batch > 1), "sweeps are of one drone"
    for row in (report["plan"], report["launch"], *report["stages"].values(), *filter(None, with_sweeps)):
        assert 0.0 <= row["median_ms"] <= row["p99_ms"]
    assert report["plans_per_second"] == pytest.approx(1e3 * batch / report["plan"]["median_ms"])
    assert report["memory_mib"] >= 0.0


def test_text_report(device: str, capsys: pytest.CaptureFixture[str]):
    assert main([*FAST, "--device", device, "--threads", "1"]) == 0
    text = capsys.readouterr().out
    for word in (
        "median ms",
        "p99 ms",
        "plan ",
        "new sweep ",
        "launch ",
        "plans per second",
        "points kept",
        "MiB",
        "16 instances",
    ):
        assert word in text


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--preset", "papr"], "'papr' is neither a preset"),
        (["--samples", "0"], "sampling.samples is 0; it must be a whole number"),
        (["--device", "gpu"], "device 'gpu' is not available"),
        (["--batch", "0"], "batch is 0"),
        (["--points", "-1"], "points is -1; it must be at least 0"),
        (["--repeat", "0"], "repeat is 0; it must be at least 1"),
    ],
)
def test_mistakes_are_reported_on_one_line(arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]):
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == "" and problem in output.err and output.err.count("\n") == 1
