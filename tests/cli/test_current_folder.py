"""Programs that are started in a folder with stray modules, as beside a downloaded map, execute none of them."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests import bags, captures
from tests.stray_modules import executed_modules, leave_what_python_imports, write_stray_modules

PROGRAM = Path(sys.executable).with_name("aero-viz")
SMALL = ["--sampling.samples", "16", "--lidar.points-per-sweep", "1000", "--rules.time-limit", "0.1"]
TUNE = ["--over", "costs.q_track", "--flights", "2", "--rungs", "1", "--trials", "2", "--check", "1"]


@pytest.fixture
def folder(tmp_path: Path, short_poles: str) -> Path:
    """A folder with a map, a recording, a world and stray modules."""
    captures.write_las(tmp_path / "map.las", np.random.default_rng(0).uniform(0.0, 9.0, (500, 3)))
    captures.write_lvx2(tmp_path / "drive.lvx2", captures.livox_packets(3))
    bags.write_mcap(tmp_path / "drive.mcap", bags.drive(3))
    (tmp_path / "world.json").write_bytes(Path(short_poles).read_bytes())
    write_stray_modules(tmp_path)
    return tmp_path


def run_there(folder: Path, *arguments: str, program: Sequence[str | Path] = (PROGRAM,)) -> None:
    """Run `aero-viz` in the folder; it must succeed, and no stray module may be executed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run([*program, *arguments], cwd=folder, capture_output=True, text=True, env=environment)
    assert executed_modules(folder) == []
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "command",
    [
        "doctor",
        "world info map.las",
        "world export world.json world.ply",
        "inspect drive.lvx2",
        "inspect drive.mcap",
        "convert drive.lvx2 converted.mcap",
    ],
)
def test_files_are_read_without_stray_modules(folder: Path, command: str):
    run_there(folder, *command.split())


def test_flights_and_logs_do_without_stray_modules(folder: Path):
    for seed in ("1", "2"):
        run_there(folder, "fly", "world.json", *SMALL, "--seed", seed, "--log", f"{seed}.mcap")
    run_there(folder, "compare", "1.mcap", "2.mcap")
    run_there(folder, "explain", "1.mcap")


def test_python_m_does_without_stray_modules(folder: Path):
    leave_what_python_imports(folder)
    run_there(folder, "world", "info", "map.las", program=(sys.executable, "-m", "aero_viz"))


def test_workers_of_ray_do_without_stray_modules(folder: Path):
    run_there(folder, "tune", "world.json", *SMALL, *TUNE, "--storage", "sqlite:///study.db", "--ray")


def test_the_page_of_a_study_does_without_stray_modules(folder: Path):
    command = [PROGRAM, "tune", "world.json", *SMALL, *TUNE, "--page", "--port", "0"]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        assert any("http://" in line for line in process.stderr)
        assert executed_modules(folder) == []
    finally:
        process.terminate()
        process.communicate()
