"""Files that a command would write over."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run, run_refused

from aero_viz.catalog import shipped_recordings

WRITERS = {
    "fly --log": ("fly", "{world}", "--log", "{file}.mcap"),
    "fly in the browser": ("fly", "{world}", "--no-headless", "--port", "0", "--log", "{file}.mcap"),
    "demo --log": ("demo", "{world}", "--port", "0", "--log", "{file}.mcap"),
    "explain --log": ("explain", "{world}", "--log", "{file}.mcap"),
    "share": ("share", "{world}", "{file}.html"),
    "world export": ("world", "export", "{world}", "{file}.pcd"),
    "convert": ("convert", "{recording}", "{file}.mcap"),
    "tune": ("tune", "{world}", "--over", "costs.q_track", "--output", "{file}.yaml"),
    "export": ("export", "{file}.tar", "--cpu"),
}


@pytest.mark.parametrize("arguments", WRITERS.values(), ids=WRITERS)
def test_an_existing_file_is_kept(
    capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path, arguments: tuple[str, ...]
):
    recording = next(iter(shipped_recordings().values()))[0]
    words = [word.format(world=short_poles, file=tmp_path / "old", recording=recording) for word in arguments]
    old = next(Path(word) for word in words if word.startswith(str(tmp_path / "old")))
    old.write_text("old")
    error = run_refused(capsys, *words)
    assert f"{old} exists already; add --overwrite to replace it" in error and error.count("\n") == 1
    assert old.read_text() == "old" and list(tmp_path.iterdir()) == [old]


@pytest.mark.parametrize("flag", ["--trajectory", "--log"])
def test_a_flight_replaces_a_trajectory_and_an_empty_file(
    capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path, flag: str
):
    path = tmp_path / "out.csv"
    path.write_text("t,x" if flag == "--trajectory" else "")
    code, _, error = run(capsys, "fly", short_poles, "--rules.time-limit", "0.1", "--json", flag, str(path))
    assert code == 0 and path.stat().st_size > 100, error


@pytest.mark.parametrize(
    "arguments",
    [
        ("fly", "{input}.json", "--trajectory", "{input}.json"),
        ("fly", "forest", "--config", "{input}.yaml", "--trajectory", "{folder}/../in/{name}.yaml"),
        ("fly", "{input}.json", "--log", "{input}.json", "--overwrite"),
        ("demo", "{input}.json", "--log", "{input}.json", "--overwrite"),
        ("explain", "{input}.mcap", "--picture", "{input}.mcap"),
        ("explain", "{input}.json", "--trajectory", "{input}.json"),
        ("world", "export", "{input}.json", "{input}.json", "--overwrite"),
        ("share", "{input}.mcap", "{input}.mcap", "--overwrite"),
        ("share", "{input}.mcap", "{input}.mcap"),
        ("snapshot", "{input}.png", "{input}.png"),
        ("tune", "{input}.json", "--over", "costs.q_track", "--output", "{input}.json", "--overwrite"),
        ("tune", "forest", "--over", "costs.q_track", "--config", "{input}.yaml", "--output", "{link}", "--overwrite"),
    ],
    ids=" ".join,
)
def test_an_input_is_never_written_over(capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: tuple[str, ...]):
    folder = tmp_path / "in"
    folder.mkdir()
    link = tmp_path / "link.yaml"
    link.symlink_to(folder / "old.yaml")
    words = [word.format(input=folder / "old", folder=folder, name="old", link=link) for word in arguments]
    files = {folder / f"old.{ending}" for ending in ("json", "yaml", "mcap", "png")}
    for path in files:
        path.write_text("old")
    error = run_refused(capsys, *words)
    assert "is read by this command and would be lost; choose another file to write" in error
    assert error.count("\n") == 1 and all(path.read_text() == "old" for path in files)


def test_a_file_in_the_folder_of_a_recording_is_never_written_over(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    source = next(iter(shipped_recordings().values()))[0]
    path = Path(shutil.copy(source, tmp_path))
    error = run_refused(capsys, "share", str(tmp_path), str(path), "--overwrite")
    assert "is read by this command and would be lost" in error and path.read_bytes() == source.read_bytes()


@pytest.mark.parametrize(
    ("command", "flag", "name", "ending"),
    [
        ("fly", "--trajectory", "flight.mcap", ".csv"),
        ("explain", "--trajectory", "flight", ".csv"),
        ("explain", "--picture", "map.png", ".svg"),
    ],
)
def test_the_name_of_a_trajectory_or_picture_has_to_say_its_format(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str, flag: str, name: str, ending: str
):
    for content in (None, "old"):
        path = tmp_path / name
        if content is not None:
            path.write_text(content)
        error = run_refused(capsys, command, "forest", flag, str(path))
        assert f"{path} is no name for a" in error and f"choose one that ends in {ending}" in error
        assert path.exists() == (content is not None) and (content is None or path.read_text() == content)


def test_overwrite_replaces_a_file(capsys: pytest.CaptureFixture[str], short_poles: str, tmp_path: Path):
    path = tmp_path / "world.json"
    path.write_text("old")
    assert run(capsys, "world", "export", short_poles, str(path), "--overwrite") == (0, f"{path}\n", "")
    assert path.read_text() == Path(short_poles).read_text()


@pytest.mark.parametrize(
    ("name", "message"),
    [("", "is a folder; give the name of a file to write"), ("absent/t.csv", "There is no folder {folder}/absent")],
)
def test_a_file_that_cannot_be_written_is_reported_before_the_flight(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, message: str
):
    error = run_refused(capsys, "fly", "forest", "--trajectory", str(tmp_path / name))
    assert message.format(folder=tmp_path) in error


def test_a_pipe_is_written_to(short_poles: str):
    command = [sys.executable, "-m", "aero_viz", "fly", short_poles, "--rules.time-limit", "0.1", "--json"]
    done = subprocess.run([*command, "--trajectory", "/dev/stderr"], capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0 and done.stderr.startswith("t,x,y,z,vx,vy,vz\n"), done.stderr
