"""Planners by name, by entry point and by module:Class, and the flags that derive from their parameters."""

import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run, run_json, run_refused, terminal_text
from straight import Straight, StraightConfig

from aero_planner import PlannerConfig
from aero_planner.config.file import config_from_name, format_config
from aero_viz.errors import UserError
from aero_viz.planners import PLANNERS, load, make, name_of
from aero_viz.planners.registry import config_of_entry, load_known, planner_entry
from aero_viz.scenes import World

PLACE = "straight:Straight"


@pytest.fixture
def empty_world(tmp_path: Path) -> str:
    """File of a world without obstacles, with the goal 8 m away."""
    World.from_dict({"name": "empty", "start": [0, 0, 2], "goal": [8, 0, 2]}).save(tmp_path / "empty.json")
    return str(tmp_path / "empty.json")


def test_the_planners_that_ship_are_found_by_name():
    assert PLANNERS.names()[:3] == ("aero_mppi", "single_mppi", "primitives")
    for name in PLANNERS.names()[:3]:
        assert load(name).Config().planner == name and name_of(load(name).Config) == name
    assert load(PlannerConfig().planner).Config is PlannerConfig


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("primitivs", "There is no planner 'primitivs' .did you mean 'primitives'"),
        ("no_such_module:Planner", "cannot be imported: ModuleNotFoundError"),
        ("straight:Straigth", "cannot be imported: AttributeError"),
        ("straight:Line", "straight:Line is not a planner; derive it from aero_viz.planners.Planner"),
    ],
)
def test_a_planner_that_cannot_be_used_is_named_with_the_reason(name: str, text: str):
    with pytest.raises(UserError, match=text):
        load(name)


def test_a_configuration_knows_its_planner():
    assert load(PLACE) is Straight and StraightConfig.planner == PLACE and Straight.parameters()[-1].path == "line.gain"
    planner = make(StraightConfig().replace({"line.gain": 3.0}), seed=4)
    assert isinstance(planner, Straight) and planner.config.line.gain == 3.0 and planner.seed == 4
    entry = {**planner_entry(planner.config), "config": planner.config.to_dict()}
    assert config_of_entry(json.loads(json.dumps(entry))) == planner.config and planner_entry(PlannerConfig()) == {}


def test_a_file_names_its_planner_and_cannot_choose_what_is_imported(tmp_path: Path):
    load(PLACE)
    file = tmp_path / "straight.yaml"
    file.write_text(format_config(StraightConfig.preset("soft")))
    assert config_from_name(file, StraightConfig).preset_name == "soft"
    with pytest.raises(ValueError, match=r"configures the planner straight:Straight, not aero_mppi; add --planner"):
        config_from_name(file)
    assert load_known(PLACE) is Straight
    with pytest.raises(UserError, match="is not registered here; add --planner this:That"):
        load_known("this:That")


def test_flags_derive_from_the_parameters_of_the_planner(empty_world: str, capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "fly", empty_world, "--planner", PLACE, "--help")
    assert code == 0 and "--line.gain" in terminal_text(text) and "--costs" not in text
    flight = ["fly", empty_world, f"--planner={PLACE}", "--line.gain", "1.5", "--lidar.points-per-sweep", "500"]
    result = run_json(capsys, *flight, "--speed", "3")
    assert result["arrived"] and result["config"] == f"{PLACE} default, changed" and result["max_speed"] < 3.5
    assert run_json(capsys, *flight[:3], "--config", "soft", *flight[5:])["config"] == f"{PLACE} soft"
    assert "line.gain is 99.0; it must be a number in [0.1, 10]" in run_refused(capsys, *flight[:4], "99")
    assert "--line.gain" in run_refused(capsys, "fly", empty_world, "--line.gain", "1")


def test_an_entry_point_brings_a_planner(empty_world: str, tmp_path: Path):
    """An installed distribution is a folder with metadata on the path; another process finds it there."""
    metadata = tmp_path / "brought-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: brought\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[aero_viz.planners]\nbrought = {PLACE}\n")
    flight = [empty_world, "--planner", "brought", "--lidar.points-per-sweep", "500", "--json"]
    added = [str(tmp_path), str(Path(inspect.getfile(Straight)).parent)]
    code = f"import sys; sys.path += {added!r}; from aero_viz.cli import main; main(sys.argv[1:])"
    done = subprocess.run([sys.executable, "-c", code, "fly", *flight], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["arrived"] and result["config"] == "brought default"
