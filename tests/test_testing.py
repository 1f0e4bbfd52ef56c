"""The plug-in of pytest: it stores how a configuration flies, and fails a test when another one flies worse."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from aero_viz.evaluation.batching import FlightOptions
from aero_viz.flight import FlightRules
from aero_viz.testing import FlightCheck

TESTS = """
import os
import pytest
from aero_viz.evaluation.batching import FlightOptions
from aero_viz.flight import FlightRules

OPTIONS = {"planner": "straight:Straight", "lidar": "brought:LIDAR", "count": 0, "flights": 6,
           "options": FlightOptions(rules=FlightRules(time_limit=6.0))}
SPEEDS = {"same": (3, 3), "slower": (4, 3), "late": (3, 1)}  # [m/s], the time limit allows 1.3
IS_CHANGED = "CHANGED" in os.environ

@pytest.mark.parametrize("case", SPEEDS)
def test_speed(case, check_flights):
    found = check_flights("brought:gate", speed=SPEEDS[case][IS_CHANGED], **OPTIONS)
    print(case, "arrived", found.arrived_a, found.arrived_b)

def test_files(check_flights):
    check_flights("gate.json", "fast.yaml", name="fast", **{**OPTIONS, "count": None})
"""


def run(folder: Path, *flags: str, **variables: str) -> str:
    """Return what pytest prints for the tests in a folder."""
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "aero_viz.testing", "-p", "no:cacheprovider", "-rPf", *flags]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **variables}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300).stdout


def test_a_configuration_that_flies_worse_than_what_was_stored_fails(tmp_path: Path):
    (tmp_path / "test_gate.py").write_text(TESTS)
    (tmp_path / "gate.json").write_text('{"name": "gate", "start": [0, 0, 2], "goal": [5, 0, 2]}')
    (tmp_path / "fast.yaml").write_text("planner: straight:Straight\nvehicle:\n  speed_limit: 4.0\n")
    text = run(tmp_path, "--aero-viz-update")
    assert "4 passed" in text, text
    baseline = json.loads((tmp_path / "baselines/test_speed-late.json").read_text())
    assert [flight["seed"] for flight in baseline["flights"]] == [0, 1, 2, 3, 4, 5]
    assert all(flight["arrived"] and 2.0 < flight["flight_time_s"] < 6.0 for flight in baseline["flights"])
    assert baseline["conditions"]["world"] == "brought:gate" and baseline["conditions"]["rules"]["time_limit"] == 6.0

    text = run(tmp_path, CHANGED="1")
    assert "2 failed, 2 passed" in text, text
    assert "same arrived 6 6" in text
    assert "Flights through brought:gate are worse than before: 6 of 6 arrive instead of 6 (p = 1), in +0." in text
    assert "Flights through brought:gate are worse than before: 0 of 6 arrive instead of 6 (p = 0.031)." in text
    assert "baselines/test_speed-late.json; if this is intended, store it with pytest --aero-viz-update." in text


CONDITIONS: dict[str, Any] = {"world": "forest", "config": "default"}


def refusal(path: Path, **options: Any) -> str:
    """Return why a baseline is refused, before anything is flown."""
    with pytest.raises(pytest.fail.Exception) as refused:
        FlightCheck(**CONDITIONS, folder=path.parent, **options).run(path, update=False)
    return str(refused.value)


def test_a_baseline_that_cannot_be_used_is_named(tmp_path: Path):
    path = tmp_path / "forest.json"
    assert refusal(path) == f"There is no baseline {path}; store one with pytest --aero-viz-update."
    for text in ("{", "[]", "{}", '{"conditions": {}, "flights": [{"seed": 3}]}'):
        path.write_text(text)
        assert f"The baseline {path} is damaged (" in refusal(path), text
    path.write_text('{"conditions": {"seed": 7, "world": "forest", "rules": {"time_limit": 5.0}}, "flights": []}')
    options = FlightOptions(rules=FlightRules(time_limit=6.0))
    assert "was flown with another seed, another rules; if this is intended, " in refusal(path, options=options)


def test_so_few_flights_that_none_could_fail_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="flights is 5; with fewer than 6, no test can tell"):
        FlightCheck(**CONDITIONS, folder=tmp_path, flights=5)
