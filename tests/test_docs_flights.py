"""The names and figures in docs/flights.md and docs/benchmarks.md are those of the code."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run
from documents import TEXTS, blocks, rows

from aero_viz.cli.missions import load_mission
from aero_viz.dashboard.layers import LAYERS
from aero_viz.evaluation.bench import BENCHMARKS
from aero_viz.flight import FlightResult
from aero_viz.flight.rules import OUTCOMES
from aero_viz.scenes import SCENES, World
from aero_viz.sensors import LIDARS, coverage, lidar_model
from aero_viz.session.engine import PLANNER_FAILED

TEXT = TEXTS["docs/flights.md"]


def test_names_are_complete():
    scenes = set(re.findall(r"`([\w-]+)`", " ".join(row[0] for row in rows(TEXT, "Worlds"))))
    assert scenes == set(SCENES)
    assert {row[0].strip("`") for row in rows(TEXT, "What ends a flight")[1:]} == {*OUTCOMES, PLANNER_FAILED} - {None}
    fields = set(re.findall(r"`(\w+)`", " ".join(row[0] for row in rows(TEXT, "Metrics"))))
    assert fields == {field.name for field in dataclasses.fields(FlightResult)}
    benchmarks = [row[0].strip("`") for row in rows(TEXTS["docs/benchmarks.md"], "Flights") if len(row) == 2]
    assert set(BENCHMARKS) <= set(benchmarks)
    assert rows(TEXT, "Sensor")[0][1:] == list(LIDARS)
    layers = {row[0] for row in rows(TEXTS["docs/page.md"], "Layers of what is not measured")[1:]}
    assert layers and layers <= {layer.title for layer in LAYERS.values()}


def test_the_session_flies_as_the_command_does(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (program,) = blocks(TEXT, "python")
    beginning = program[: program.index("session.seek")]
    code = f"{beginning}print(*frames[-1].observation.actual_state.position)\nsession.close()\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    table = tmp_path / "t.csv"
    options = ("--rules.time-limit", "1", "--trajectory", str(table))
    assert run(capsys, "fly", "forest", "--seed", "3", *options)[0] == 0
    row = table.read_text(encoding="utf-8").splitlines()[1 + 49]
    place = [float(number) for number in row.split(",")[1:4]]
    assert list(map(float, done.stdout.split())) == pytest.approx(place, abs=1e-6)


def test_coverage_equals_the_table():
    for cell, row in ((3.0, rows(TEXT, "Sensor")[-2]), (1.0, rows(TEXT, "Sensor")[-1])):
        assert row[0] == f"{cell:g} deg cells hit after 0.1, 0.5, 1.0 s"
        for name, text in zip(LIDARS, row[1:], strict=True):
            documented = [float(percent) for percent in re.findall(r"\d+", text)]
            assert documented == pytest.approx(100.0 * coverage(lidar_model(name), cell=cell), abs=0.51), (name, cell)


def test_the_mission_of_the_document_is_one(tmp_path: Path):
    block = next(part for part in TEXT.split("```") if part.startswith("\nwaypoints:"))
    (tmp_path / "tour.yaml").write_text(block, encoding="utf-8")
    (tmp_path / "walk.csv").write_text("t,x,y,z\n0,25,0,2\n9,40,0,2\n", encoding="utf-8")
    first, second, walk = load_mission(tmp_path / "tour.yaml").waypoints
    assert (first.speed, second.radius, second.timeout, walk.stop, walk.duration) == (3.0, 0.5, 20.0, True, 9.0)


def test_keys_of_a_world_file_are_complete():
    keys = re.findall(r'"(\w+)":', TEXT.split("**A world on disk**")[1].split("```")[1])
    mission = {"waypoints": [{"position": [9, 0, 2]}]}
    tables = {
        "mission": mission,
        "cylinders": [[5, 5, 0, 0, 0, 1, 1, 2]],
        "motion": [[1, 0, 3]],
        "triangles": [[0] * 8 + [1]],
    }
    world = World.from_dict({"name": "w", "start": [0, 0, 2], "goal": [9, 0, 2], **tables})
    assert set(keys) == {*json.loads(json.dumps(world.to_dict())), "bounds"}
