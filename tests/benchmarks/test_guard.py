import json
import subprocess
import sys

import pytest

from benchmarks.guard import main

SHORT = ["--points", "20000", "--samples", "32", "--repeat", "7"]


def test_the_planner_is_faster_than_the_reference(device: str):
    """A ratio below the bound is a slow-down on any machine; it was 110 on one thread of an Intel Xeon."""
    bound = "50" if device == "cpu" else "1"
    assert main([*SHORT, "--device", device, "--bound", bound]) == 0


def test_report_names_stages_and_ratios(capsys: pytest.CaptureFixture[str]):
    assert main([*SHORT, "--bound", "0"]) in (0, 1)
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[2:]}
    for name in ("partition", "plan", "default"):
        reference, planner, ratio = (float(value) for value in rows[name])
        assert ratio == pytest.approx(reference / planner, rel=0.05)


def test_a_slow_down_is_reported_and_fails(capsys: pytest.CaptureFixture[str]):
    assert main([*SHORT, "--bound", "1e6", "--json"]) == 1
    output = capsys.readouterr()
    report = json.loads(output.out)
    assert "plan" in report["slow"] and report["bounds"]["plan"] == 1e6
    assert 0.0 < report["plan"]["ratio"] < 1e6 and report["samples"] == 32
    assert "plan: " in output.err and "1e+06 times or more" in output.err


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--device", "gpu"], "device 'gpu' is not available"),
        (["--points", "0"], "0 is less than 1"),
    ],
)
def test_mistakes_are_reported(arguments: list[str], problem: str):
    done = subprocess.run([sys.executable, "-m", "benchmarks.guard", *arguments], capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert problem in done.stderr.splitlines()[-1] and "Traceback" not in done.stderr
