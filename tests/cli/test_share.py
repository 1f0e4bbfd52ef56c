"""`aero-viz share` and `explain`: the flight that `fly` and `demo` fly, and what is refused."""

import re
from pathlib import Path

import pytest
from command_line import run, run_json, run_refused

from aero_viz.catalog import shipped_recordings


def test_the_page_names_the_command_without_the_flags_of_the_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, poles: str, tmp_path: Path
):
    monkeypatch.chdir(tmp_path)
    arguments = ["share", poles, "./out.html", "--duration=0.1", "--layers", "drone", "--overwrite", "--seed", "3"]
    monkeypatch.setattr("sys.argv", ["aero-viz", *arguments])
    assert run(capsys, *arguments)[0] == 0
    page = Path("out.html").read_text(encoding="utf-8")
    assert page.index("The MIT License") < page.index("<title>")
    command = re.search(r"<code>(.*?)</code>", page)
    assert command is not None and command[1] == f"aero-viz demo {poles} --seed 3"


def test_a_shared_flight_is_the_one_that_fly_flies(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    flown, shared = tmp_path / "flown.mcap", tmp_path / "shared.mcap"
    scene = ("double_wall_trap", "--rules.time-limit", "0.6")  # in which the top of the world matters at once
    run_json(capsys, "fly", *scene, "--speed", "3", "--log", str(flown), "--json")
    assert run(capsys, "share", scene[0], str(shared), "--duration", "0.6", "--speed", "3")[0] == 0
    assert run_json(capsys, "compare", str(flown), str(shared), "--json")["parameters"] == {}


def test_a_scene_is_flown_also_next_to_a_folder_of_its_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    (tmp_path / "wall").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "share", "wall", "wall.mcap", "--duration", "0.1")[0] == 0


def test_flags_of_a_flight_are_refused_for_a_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    recording = str(next(iter(shipped_recordings().values()))[0])
    message = run_refused(capsys, "share", recording, str(tmp_path / "out.mcap"), "--count", "3")
    assert "is a recording" in message and not list(tmp_path.iterdir())


def test_a_report_is_printed_also_if_there_is_no_picture(
    capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path
):
    code, out, error = run(capsys, "explain", short_poles, "--picture", str(tmp_path / "map.svg"))
    assert code == 2 and "there is nothing to explain" in out and "--picture" in error


def test_a_log_is_explained_whatever_its_name(capsys: pytest.CaptureFixture[str], poles: str, tmp_path: Path):
    log = str(tmp_path / "flight.log")
    run_json(capsys, "fly", poles, "--rules.time-limit", "0.3", "--log", log, "--json")
    assert run_json(capsys, "explain", log, "--json")["outcome"] == "timeout"
