"""What the wheels of both distributions hold."""

import email
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = {"aero_viz": ROOT, "aero_planner": ROOT / "planner"}


def build(package: str, kind: str, folder: Path) -> zipfile.ZipFile:
    """Build a "wheel" or the wheel of an "editable" installation."""
    project, output = folder / "project", folder / "output"
    source = DISTRIBUTIONS[package]
    shutil.copytree(source / package, project / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(source / name, project)
    output.mkdir()
    code = f"import setuptools.build_meta as b, sys; b.build_{kind}(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(output)], cwd=project, check=True, capture_output=True)
    return zipfile.ZipFile(next(output.glob("*.whl")))


def test_the_recordings_ship_with_the_wheel(tmp_path: Path):
    with build("aero_viz", "wheel", tmp_path) as wheel:
        names = set(wheel.namelist())
    assert {"aero_viz/datasets/forest_mid360.mcap", "aero_viz/datasets/room_mid360.mcap", "aero_viz/py.typed"} <= names


@pytest.mark.parametrize("place", ["docs/onboard.md", "planner/docker/Dockerfile"])
def test_what_is_installed_on_the_drone_is_an_extra_of_the_wheel(tmp_path: Path, place: str):
    with build("aero_planner", "wheel", tmp_path) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = email.message_from_bytes(wheel.read(name))
    (installed,) = re.findall(r"aero_planner-\*\.whl\)\[(.+)\]", (ROOT / place).read_text(encoding="utf-8"))
    assert {"mavlink", "log"} <= set(installed.split(",")) <= set(metadata.get_all("Provides-Extra", []))


@pytest.mark.parametrize("package", DISTRIBUTIONS)
def test_an_editable_installation_is_a_path_that_type_checkers_follow(tmp_path: Path, package: str):
    with build(package, "editable", tmp_path) as wheel:
        [path] = [name for name in wheel.namelist() if name.endswith(".pth")]
        assert wheel.read(path).decode().strip() == str(tmp_path / "project")
