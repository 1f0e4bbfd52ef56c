"""A bundle for all tests, which takes long to compile."""

import contextlib
import fcntl
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import warp as wp

from aero_planner.deploy.export import makes_graphs

CONFIG = """# tuned in the forest
costs:
  q_track: 7.5   # stays as it is
  use_ground: false
onboard:
  lidar:
    host: 127.0.0.1
    port: 0
    points_max: 3000
  mavlink:
    url: 'udpin:127.0.0.1:0'
  telemetry:
    port: 0
"""


@pytest.fixture(scope="session")
def export_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that all workers of a run share."""
    root = tmp_path_factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "export"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def bundle_config(export_folder: Path) -> Path:
    """A configuration of planner and node."""
    path = export_folder / "tuned.yaml"
    with locked(export_folder):
        if not path.exists():
            path.write_text(CONFIG)
    return path


@pytest.fixture(scope="session")
def cpu_compiler() -> None:
    """Skips where Warp has no compiler for the CPU."""
    if not wp.is_cpu_available():
        pytest.skip("this machine's Warp has no compiler for the CPU: bundles for it were not tested")


@pytest.fixture(scope="session")
def bundle(bundle_config: Path, export_folder: Path, cpu_compiler: None) -> Path:
    """Folder with a bundle for an Orin and for this machine's CPU, made by the command line, once for all workers."""
    path = export_folder / "bundle" / "orin"
    with locked(export_folder):
        if not path.exists():
            path.parent.mkdir()
            export(bundle_config, path)
    return path


def export(config: Path, path: Path) -> None:
    """Export a bundle and check what the command leaves behind."""
    command = [
        sys.executable,
        "-m",
        "aero_planner",
        "export",
        "--config",
        str(config),
        "--arch",
        "sm_87",
        "--cpu",
    ]
    done = subprocess.run([*command, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    graphs = ", graphs of cpu" if makes_graphs() else ""
    assert re.fullmatch(rf"{path}: sm_87, \S+{graphs}; \d+ files, [\d.]+ MB, in \d+ s\n", done.stdout)
    assert os.listdir(path.parent) == ["orin"]  # no temporary files are left


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Wait until no other worker is in this block."""
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
