"""The flags, names and figures in docs/flights.md are those of the code."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from aero_viz.cli import main
from aero_viz.evaluation.bench import BENCHMARKS
from aero_viz.flight import FlightResult, FlightRules, StateNoise, VehicleModel
from aero_viz.flight.rules import OUTCOMES
from aero_viz.scenes import SCENES, World
from aero_viz.sensors import LIDARS, LidarModel, coverage, lidar_model

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "flights.md").read_text(encoding="utf-8")
KINDS = {"lidar": LidarModel, "drone": VehicleModel, "noise": StateNoise, "rules": FlightRules}


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the tables below a heading."""
    part = TEXT.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    table = [line for line in part.splitlines() if line.startswith("|") and "---" not in line]
    return [[cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table]


def test_every_flag_exists(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["fly", "--help"])
    shown = capsys.readouterr().out
    elsewhere = {"--resume", "--include", "--table", "--planner", "--world", "--batch", "--flights", "--spacing"}
    flags = set(re.findall(r"--[a-z][a-z.-]*[a-z]", TEXT)) - elsewhere - {"--vehicle"}
    assert len(flags) > 20 and [flag for flag in flags if flag not in shown] == []


def test_names_are_complete():
    scenes = set(re.findall(r"`([\w-]+)`", " ".join(row[0] for row in rows("Worlds"))))
    assert scenes == set(SCENES)
    assert {row[0].strip("`") for row in rows("What ends a flight")[1:]} == set(OUTCOMES) - {None}
    fields = set(re.findall(r"`(\w+)`", " ".join(row[0] for row in rows("Metrics"))))
    assert fields == {field.name for field in dataclasses.fields(FlightResult)}
    assert {row[0].strip("`") for row in rows("Benchmarks")[1:]} == set(BENCHMARKS)
    assert rows("Sensor")[0][1:] == list(LIDARS)


def test_parameters_of_the_vehicle_are_complete():
    text = " ".join(cell for row in rows("Vehicle") for cell in row) + TEXT
    for section in ("drone", "noise"):
        for info in KINDS[section].parameters():
            assert info.name.replace("_", "-") in text, info.path


def test_coverage_equals_the_table():
    for cell, row in ((3.0, rows("Sensor")[-2]), (1.0, rows("Sensor")[-1])):
        assert row[0] == f"{cell:g} deg cells hit after 0.1, 0.5, 1.0 s"
        for name, text in zip(LIDARS, row[1:], strict=True):
            documented = [float(percent) for percent in re.findall(r"\d+", text)]
            assert documented == pytest.approx(100.0 * coverage(lidar_model(name), cell=cell), abs=0.51), (name, cell)


def test_keys_of_a_world_file_are_complete():
    keys = re.findall(r'"(\w+)":', TEXT.split("**A world on disk**")[1].split("```")[1])
    tables = {"cylinders": [[5, 5, 0, 0, 0, 1, 1, 2]], "motion": [[1, 0, 3]], "triangles": [[0] * 8 + [1]]}
    world = World.from_dict({"name": "w", "start": [0, 0, 2], "goal": [9, 0, 2], **tables})
    assert set(keys) == {*json.loads(json.dumps(world.to_dict())), "bounds"}
