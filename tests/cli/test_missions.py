"""Missions on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run, run_json, run_refused

from aero_viz.cli.flags import WorldFlags
from aero_viz.cli.missions import load_mission
from aero_viz.scenes import World

FAST = ("--sampling.samples", "16", "--seed", "1")


def test_waypoints_are_flown_in_order(capsys: pytest.CaptureFixture[str], poles: str):
    result = run_json(capsys, "fly", poles, "--waypoint", "4,1.4,2", "--waypoint=-1,3,2,speed=3", *FAST)
    assert result["arrived"] and (result["waypoints"], result["waypoints_passed"]) == (2, 2)


def test_a_file_gives_the_mission_with_a_recorded_path(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path):
    (tmp_path / "walk.csv").write_text("t,x,y,z\n5,0,2,2\n5.02,0.1,2,2\n8,4,4,2\n", encoding="utf-8")
    path = tmp_path / "tour.yaml"
    path.write_text(
        "waypoints:\n  - position: [0, 2, 2]\n    radius: 0.5\n  - {path: walk.csv, stop: true}\n", encoding="utf-8"
    )
    mission = load_mission(path)
    assert mission.waypoints[0].radius == 0.5 and mission.waypoints[1].duration == 3.0
    assert mission.waypoints[1].path == ((5, 0, 2, 2), (8, 4, 4, 2))  # rows are at least 0.1 s apart
    result = run_json(capsys, "fly", poles, "--mission", str(path), *FAST)
    assert result["arrived"] and result["waypoints_passed"] == 2 and result["flight_time_s"] > 3.0


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "the mission has None; it must have the key waypoints"),
        ("waypoints: [{position: [1, 2]}]", "waypoint 1: the position is [1, 2]; it must be the 3 numbers x, y, z."),
        (
            "waypoints: [{position: [1, 2, 3]}, {position: [1, 2, 3], speed: 0}]",
            "waypoint 2: vehicle.speed_limit is 0.0",
        ),
        ("waypoints: [{path: missing.csv}]", "missing.csv: No such file"),
        ("a: &x [1]\nwaypoints: *x", "is YAML with aliases, which are not read"),
        ("waypoints: [", "is not YAML"),
    ],
)
def test_a_malformed_file_is_named_with_what_is_wrong(
    capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path, text: str, problem: str
):
    path = tmp_path / "tour.yaml"
    path.write_text(text, encoding="utf-8")
    error = run_refused(capsys, "fly", poles, "--mission", str(path))
    assert problem in error and (str(path) in error or "missing.csv" in error)


@pytest.mark.parametrize(
    ("flags", "problem"),
    [
        (("--waypoint", "1,2"), "the waypoint '1,2' is not of the form X,Y,Z[,radius=R]"),
        (("--waypoint", "1,2,2", "--goal", "3", "0", "2"), "--waypoint and --goal both say where to fly; give one."),
        (("--mission", "a.yaml", "--waypoint", "1,2,2"), "--waypoint and --mission both say where to fly"),
        (("--mission", "missing.yaml"), "Cannot read the mission missing.yaml: No such file"),
        (("--waypoint", "1,2,900", "--waypoint", "9,2,2"), "Waypoint 1 of 2, (1, 2, 900), lies outside the bounds"),
    ],
)
def test_flags_that_cannot_be_flown_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, flags: tuple[str, ...], problem: str
):
    world = {"name": "w", "start": [0, 0, 2], "goal": [9, 0, 2], "bounds": [[-20, -20, 0], [20, 20, 20]]}
    (tmp_path / "w.json").write_text(json.dumps(world), encoding="utf-8")
    assert problem in run_refused(capsys, "fly", str(tmp_path / "w.json"), *flags)


def test_an_exported_world_keeps_its_mission(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path):
    path = tmp_path / "w.json"
    assert run(capsys, "world", "export", poles, str(path), "--waypoint", "4,1.4,2,stop", "--waypoint", "9,0,2")[0] == 0
    mission = World.load(path).route
    assert [waypoint.stop for waypoint in mission.waypoints] == [True, False] and mission.goal == (9.0, 0.0, 2.0)
    info = run_json(capsys, "world", "info", str(path))
    assert info["mission"] == mission.to_dict()
    goal = WorldFlags(goal=(5.0, 0.0, 2.0)).load(str(path), seed=0)
    assert goal.mission is None and goal.route.goal == (5.0, 0.0, 2.0)


def test_a_mission_in_a_map_moves_with_the_map(tmp_path: Path):
    rng = np.random.default_rng(0)
    far = np.array([400_000.0, 5_000_000.0, 0.0])
    np.save(tmp_path / "park.npy", rng.uniform([0, 0, 0], [30, 30, 0.1], (4000, 3)) + far)
    texts = [f"{x + far[0]},{y + far[1]},2" for x, y in ((5, 5), (20, 20))]
    flags = WorldFlags(waypoint=tuple(texts), start=(400_002.0, 5_000_002.0, 2.0))
    world = flags.load(str(tmp_path / "park.npy"), seed=0)
    first, last = (np.array(waypoint.position) for waypoint in world.route.waypoints)
    np.testing.assert_allclose(last - first, [15.0, 15.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(first - world.start, [3.0, 3.0, 0.0], atol=1e-6)


def test_the_worlds_of_a_folder_are_flown_with_one_mission(
    capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path
):
    folder = tmp_path / "worlds"
    folder.mkdir()
    (folder / "a.json").write_text(Path(poles).read_text(encoding="utf-8"), encoding="utf-8")
    report = run_json(
        capsys, "bench", "worlds", str(folder), "--waypoint", "4,1.4,2", "--waypoint", "9,2,2", "--no-examine",
        "--output", str(tmp_path / "out"), "--sampling.samples", "16",
    )  # fmt: skip
    assert report["summary"][0]["arrived"] == 1
