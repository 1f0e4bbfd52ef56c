"""Parts by name: those that ship, those of entry points, those that are added, and "module:attribute"."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brought import MAGIC
from command_line import run_json, run_refused

from aero_viz.errors import UserError
from aero_viz.registry import Registry
from aero_viz.scenes import scene

KINDS = {
    "scene": ("gate = brought:gate", "forest = brought:gate"),
    "LiDAR": ("sparse = brought:LIDAR", "dense = brought:gate"),
    "format": ("triples = brought:open_triples", "torn = not_there:open_torn"),
    "layer": ("nothing = brought:Nothing", "something = brought:Nothing"),
    "panel": ("note = brought:Note", "torn = brought:Torn"),
    "command": ("greet = brought:greet", "torn = torn_module:run"),
    "planner": ("straight = straight:Straight", "torn = straight:Line"),
    "cost term": ("altitude = altitude:TERM", "torn = torn_module:TERM"),
    "model": ("tank = altitude:TANK", "acceleration = altitude:TANK"),
}
"""Entry points of each kind: one that is used, and one that is left out."""
GROUPS = {
    "scene": "aero_viz.scenes", "LiDAR": "aero_viz.sensors", "format": "aero_viz.formats", "layer": "aero_viz.layers",
    "panel": "aero_viz.panels", "command": "aero_viz.commands", "planner": "aero_viz.planners",
    "cost term": "aero_planner.cost_terms", "model": "aero_planner.models",
}  # fmt: skip
ALTITUDE = """
from aero_planner.costs import CostTerm
from aero_planner.models import VehicleModel
TANK = VehicleModel("tank", "Tank", (("speed", "m/s"), ("turn", "rad/s"), ("", ""), ("", "")), *[None] * 6)
TERM = CostTerm("altitude", "altitude")
"""
PAGE = """
import sys
from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers import LAYERS
from aero_viz.dashboard.panels.layout import PANELS
from aero_viz.session import Session
from brought import Raising, RaisingLayer
LAYERS.add("raising", RaisingLayer)
PANELS.add("raising", Raising)
session = Session(open_source("gate", lidar="sparse", seed=1))
dashboard = Dashboard(session, port=0)
frame = session.tick()
print(*dashboard.layers, *(type(panel).__name__ for panel in dashboard.panels), len(dashboard.changes(frame)) > 10)
dashboard.close()
session.close()
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of a process in which a distribution with all of these entry points is installed."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "altitude.py").write_text(ALTITUDE)
    (folder / "torn_module.py").write_text("import sys\nsys.exit('torn\\napart')\n")
    metadata = folder / "acme-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    sections = (f"[{GROUPS[kind]}]\n" + "\n".join(lines) + "\n" for kind, lines in KINDS.items())
    (metadata / "entry_points.txt").write_text("".join(sections))
    paths = [str(folder), str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def python(installed: dict[str, str], *arguments: str) -> tuple[str, str]:
    """Return what a program prints on stdout and stderr, without a traceback."""
    command = [sys.executable, *arguments]
    done = subprocess.run(command, env=installed, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout, done.stderr


def test_the_doctor_lists_everything_that_was_brought(installed: dict[str, str]):
    text, error = python(installed, "-m", "aero_viz", "doctor", "--json")
    report = json.loads(text)
    assert report["passed"]
    states = {(plug_in["kind"], plug_in["name"]): plug_in for plug_in in report["plug_ins"]}
    assert len(states) == 2 * len(KINDS) and {plug_in["distribution"] for plug_in in states.values()} == {"acme 1.0"}
    for kind, (used, left_out) in KINDS.items():
        name, place = used.split(" = ")
        assert (states[kind, name]["state"], states[kind, name]["place"]) == ("ok", place)
        problem = states[kind, left_out.split(" = ")[0]]["state"]
        assert problem != "ok" and "\n" not in problem and problem.rstrip(".") in error
    assert "there is one of that name already" in states["scene", "forest"]["state"]
    assert "ModuleNotFoundError: No module named 'not_there'" in states["format", "torn"]["state"]
    assert "AttributeError" in states["panel", "torn"]["state"] and "torn apart" in states["command", "torn"]["state"]
    rows = [check for check in report["checks"] if check["name"] == "scene gate"]
    assert rows[0]["ok"] and rows[0]["finding"] == "acme 1.0, brought:gate"


def test_what_was_brought_is_used_like_what_ships(installed: dict[str, str], tmp_path: Path):
    flight = ("fly", "gate", "--lidar", "sparse", "--count", "1", "--planner", "straight", "--json")
    result = json.loads(python(installed, "-m", "aero_viz", *flight)[0])
    assert result["arrived"] and result["scene"] == "gate-0"
    (tmp_path / "points.bin").write_bytes(MAGIC + np.ones((5, 3), "<f4").tobytes())
    info = json.loads(python(installed, "-m", "aero_viz", "inspect", str(tmp_path / "points.bin"), "--json")[0])
    assert (info["format"], info["sweeps"]) == ("triples", 1)
    assert python(installed, "-m", "aero_viz", "greet", "--name", "drone")[0] == "Hello, drone!\n"
    text, error = python(installed, "-m", "aero_viz", "--help")
    assert (
        "Greet somebody." in text and error.count("The command torn cannot be imported: SystemExit: torn apart.") == 1
    )


def test_a_page_has_the_layers_and_panels_that_were_brought(installed: dict[str, str]):
    text, error = python(installed, "-c", PAGE)
    words = text.split()
    assert {"nothing", "rollouts", "Note", "CurvePanel"} <= set(words) and words[-1] == "True"
    assert not {"something", "raising", "Raising"} & set(words)
    for part in ("layer", "panel"):
        assert f"The {part} raising is left out: KeyError: 'torn apart'" in error


def take(name: str, found: Any) -> int:
    if not isinstance(found, int):
        raise UserError(f"{name} is not a number.")
    return found


@pytest.fixture
def numbers() -> Registry[int]:
    return Registry("number", "aero_viz.no_such_group", {"one": 1, "largest": "sys:maxsize"}, take, others="a digit")


def test_parts_are_found_by_name_and_place(numbers: Registry[int]):
    assert dict(numbers) == {"one": 1, "largest": sys.maxsize} and numbers.name_of("sys:maxsize") == "largest"
    numbers.add("two", 2)
    assert numbers.names() == ("one", "largest", "two") and numbers["two"] == 2 and len(numbers) == 3
    with pytest.raises(ValueError, match="There is a number 'one' already"):
        numbers.add("one", 3)
    with pytest.raises(UserError, match="three is not a number"):
        numbers.add("three", "3")
    assert numbers.admit("./a:b.json") == "./a:b.json" and numbers.admit("one") == "one"
    assert numbers.load("sys:hexversion") == sys.hexversion


def test_a_file_or_a_link_does_not_choose_what_is_imported(numbers: Registry[int], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with pytest.raises(UserError, match="There is no number 'this:c'; give one of one, largest, or a digit"):
        numbers.known("this:c")
    with pytest.raises(UserError, match="There is no scene 'this:that'"):
        scene("this:that")
    assert "this" not in sys.modules and "this:c" not in numbers
    numbers.admit("sys:hexversion")
    assert numbers.known("sys:hexversion") == sys.hexversion  # the command line has named it


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("onne", "There is no number 'onne' .did you mean 'one'"),
        ("no_such_module:x", "The number no_such_module:x cannot be imported: ModuleNotFoundError: No module named"),
        ("sys:no_such", "The number sys:no_such cannot be imported: AttributeError"),
        ("sys:path", "sys:path is not a number"),
    ],
)
def test_a_part_that_cannot_be_used_is_named_with_the_reason(numbers: Registry[int], name: str, text: str):
    for _ in range(2):
        with pytest.raises(UserError, match=text):
            numbers.load(name)


def test_scenes_and_lidars_are_named_by_their_place_on_the_command_line(capsys: pytest.CaptureFixture[str]):
    flight = ("fly", "brought:gate", "--lidar", "brought:LIDAR", "--planner", "straight:Straight", "--count", "0")
    assert run_json(capsys, *flight)["scene"] == "gate-0"
    assert "brought:MAGIC is not a scene" in run_refused(capsys, "fly", "brought:MAGIC")
    assert "no_such:LIDAR cannot be imported" in run_refused(capsys, "fly", "forest", "--lidar", "no_such:LIDAR")
    assert "There is no LiDAR 'mid36' (did you mean 'mid360'?)" in run_refused(capsys, "fly", "forest", "--lidar=mid36")
