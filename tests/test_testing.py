"""The plug-in of pytest: it stores how a configuration flies, and fails a test when another one flies worse."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from straight import StraightConfig

from aero_planner.config.file import save_config

TEST = """
from aero_viz.evaluation.batching import FlightOptions
from aero_viz.flight import FlightRules

def test_speed(check_flights):
    rules = FlightRules(time_limit=6.0)
    found = check_flights("brought:gate", {config!r}, planner="straight:Straight", flights=6, count=0, speed={speed},
                          lidar="brought:LIDAR", options=FlightOptions(rules=rules))
    print("arrived", found.arrived_b)
"""


def run(folder: Path, *flags: str, speed: float = 3.0, config: str = "default") -> tuple[int, str]:
    """Return the exit code and the output of pytest in a folder with one test."""
    (folder / "test_speed.py").write_text(TEST.format(speed=speed, config=config))
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "aero_viz.testing", "-p", "no:cacheprovider", "-rP", *flags]
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """Folder with a test and its baseline, at 3 m/s."""
    code, text = run(tmp_path, "--aero-viz-update")
    assert code == 0, text
    return tmp_path


def test_flights_are_stored_and_compared(stored: Path):
    baseline = json.loads((stored / "baselines/test_speed.json").read_text())
    assert [flight["seed"] for flight in baseline["flights"]] == [0, 1, 2, 3, 4, 5]
    assert baseline["conditions"]["world"] == "brought:gate" and baseline["conditions"]["rules"]["time_limit"] == 6.0
    code, text = run(stored)
    assert code == 0 and "arrived 6" in text, text
    code, text = run(stored, speed=4.0)
    assert code == 0, "faster is not worse"


def test_a_configuration_that_flies_worse_fails(stored: Path):
    code, text = run(stored, speed=2.0)
    assert code == 1 and "worse than before: 6 of 6 arrive instead of 6 (p = 1), in +1." in text, text
    assert "baselines/test_speed.json; if this is intended, store it with pytest --aero-viz-update." in text
    save_config(StraightConfig().replace({"line.gain": 0.2}), stored / "soft.yaml")
    code, text = run(stored, config="soft.yaml", speed=1.0)
    assert code == 1 and "worse than before: 0 of 6 arrive instead of 6 (p = 0.031)" in text, text
    assert run(stored, "--aero-viz-update", config="soft.yaml", speed=1.0)[0] == 0
    assert run(stored, config="soft.yaml", speed=1.0)[0] == 0


def test_a_baseline_that_cannot_be_used_is_named(tmp_path: Path, stored: Path):
    file = stored / "baselines/test_speed.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "conditions": {**content["conditions"], "seed": 7}}))
    assert "was flown with another seed; " in run(stored)[1]
    file.write_text(json.dumps({"flights": 3}))
    code, text = run(stored)
    assert code == 1 and "is damaged ('conditions'); store it again" in text
    file.unlink()
    assert "There is no baseline" in run(stored)[1]
