"""The core is enough to fly and to serve the page; a command that needs an extra names it."""

import json
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from aero_viz.errors import UserError
from aero_viz.scenes.las import read_las
from tests.scripts.test_pins import requirements_of

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PLANNER = tomllib.loads((ROOT / "planner" / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]

WITHOUT = """
import json, sys

class Absent:
    names = frozenset(json.loads(sys.argv.pop(1)))

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}")

sys.meta_path.insert(0, Absent())
from aero_viz.__main__ import main
sys.exit(main())
"""
"""The command line where some modules are not installed: names of the modules as JSON, then its arguments."""


def applying(texts: Iterable[str], extras: Iterable[str] = ()) -> list[Requirement]:
    """Return the requirements that apply to this machine, with some extras."""
    found = map(Requirement, texts)
    return [r for r in found if r.marker is None or any(r.marker.evaluate({"extra": e}) for e in ("", *extras))]


def closure(requirements: list[str]) -> set[str]:
    """Return the distributions that requirements lead to, as installed."""
    found, waiting = set[str](), applying(requirements)
    while waiting:
        requirement = waiting.pop()
        key = f"{canonicalize_name(requirement.name)}{sorted(requirement.extras)}"
        if key in found:
            continue
        found.add(key)
        if requirement.name == "aero-planner":
            waiting += applying(PLANNER["dependencies"])
            waiting += applying(t for e in requirement.extras for t in PLANNER["optional-dependencies"][e])
        elif requirement.name == "aero-viz":
            waiting += applying(text for extra in requirement.extras for text in EXTRAS[extra])
        else:
            waiting += applying(metadata.requires(requirement.name) or [], requirement.extras)
    return {key.partition("[")[0] for key in found} - {"aero-planner", "aero-viz"}


CORE = closure(PROJECT["dependencies"])
OPTIONAL = closure(EXTRAS["all"]) - CORE


def pinned(section: str) -> set[str]:
    return {canonicalize_name(pin.name) for pin in requirements_of(section)}


def test_the_pins_are_those_of_the_core_and_of_its_extras():
    # setuptools builds the two packages in the environment.
    assert pinned("Product") == CORE | {"setuptools"}
    assert pinned("Extras") == OPTIONAL
    assert not OPTIONAL & pinned("Tests")


def test_the_extra_all_has_every_extra_of_users():
    (everything,) = EXTRAS["all"]
    assert Requirement(everything).extras == set(EXTRAS) - {"all", "bench", "fuzz", "dev"}


def run_core(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command where no extra is installed."""
    owners = metadata.packages_distributions()
    absent = [module for module, names in owners.items() if {canonicalize_name(name) for name in names} <= OPTIONAL]
    command = [sys.executable, "-P", "-c", WITHOUT, json.dumps(absent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, stdin=subprocess.DEVNULL, timeout=120)


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly", "forest", "--rules.time-limit", "0.2", "--json"],
        ["inspect", str(ROOT / "aero_viz" / "datasets" / "room_mid360.mcap"), "--json"],
        ["parameters"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_the_core_is_enough(tmp_path: Path, arguments: list[str]):
    done = run_core(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr


@pytest.mark.parametrize(
    ("extra", "arguments"),
    [
        ("pictures", ["snapshot", "forest", "picture.png"]),
        ("tune", ["tune", "forest", "--over", "costs.q_track"]),
        ("ray", ["bench", "success", "--flights", "1", "--ray"]),
        ("ros", ["live"]),
        ("odometry", ["play", str(ROOT / "aero_viz" / "datasets" / "room_mid360.mcap"), "--odometry", "kiss-icp"]),
    ],
)
def test_a_command_names_the_extra_that_it_needs(tmp_path: Path, extra: str, arguments: list[str]):
    done = run_core(*arguments, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert f"pip install '.[{extra}]'" in done.stderr


def test_a_file_names_the_extra_that_its_format_needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(UserError, match=r"map\.las and other LAS files need the extra 'formats': run pip install"):
        read_las(tmp_path / "map.las")
