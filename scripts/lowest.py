"""Run the planner's tests with the lowest versions that its wheel allows: scripts/lowest.py [arguments of pytest].

The script builds the wheel and installs it into .venv-lowest. Dependencies with a lower bound are installed at that
bound, or at the lowest version above it that has a binary for this Python; all others as in constraints.txt. Nothing is
reinstalled while the sources and requirements stay the same. PYTHON=python3.13 selects another interpreter.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import PathDistribution
from pathlib import Path
from zipfile import Path as ZipPath

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "planner"
CONSTRAINTS = ROOT / "constraints.txt"
HOME = ROOT / ".venv-lowest"
INTERPRETER = HOME / "bin" / "python"
PINS = HOME / "constraints.txt"
"""Installed versions, which tests/planner/test_distribution.py checks."""
EXTRAS = ("log", "mavlink", "test")
"""Extras of the wheel that its tests need."""


class InstallError(Exception):
    """Something could not be installed; the message names the command and the error of pip."""


class UnreachableError(InstallError):
    """The package registry did not answer."""


def main() -> int:
    """Run the tests; return the exit code of pytest, or 2 if the installation failed.

    Outside CI, an unreachable package registry is not an error.
    """
    try:
        with locked():
            install()
    except InstallError as error:
        print(f"THE LOWEST VERSIONS WERE NOT TESTED: {error}", file=sys.stderr)
        return 0 if isinstance(error, UnreachableError) and not os.environ.get("CI") else 2
    command = [INTERPRETER, "-m", "pytest", "-o", "testpaths=tests/planner", *sys.argv[1:]]
    return subprocess.call(command, cwd=ROOT, env={**os.environ, "AERO_PLANNER_PINS": str(PINS)})


@contextlib.contextmanager
def locked() -> Iterator[None]:
    """Wait until no other run of this script installs."""
    with Path(__file__).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def install() -> None:
    """Update .venv-lowest.

    Raises:
        InstallError: pip failed.
    """
    python = os.environ.get("PYTHON") or sys.executable
    environment = digest([SOURCES / "pyproject.toml", CONSTRAINTS, Path(__file__)], python)
    content = digest(sorted((SOURCES / "aero_planner").rglob("*.py")), environment)
    if stamp("content") == content:
        return
    if stamp("environment") != environment:
        print("Creating .venv-lowest ...", file=sys.stderr)
        run(python, "-m", "venv", "--clear", HOME)
        (setuptools,) = re.findall(r"^setuptools==\S+", CONSTRAINTS.read_text(), re.MULTILINE)
        pip("install", setuptools)
        wheel = build_wheel()
        pins = lowest_versions(wheel)
        bounded = {canonicalize_name(pin.split("==")[0]) for pin in pins}
        # The lowest versions have no hashes in constraints.txt, and pip checks either all hashes or none.
        others = re.findall(r"^[\w.-]+==[^\s;\\]+", CONSTRAINTS.read_text(), re.MULTILINE)
        others = [line for line in others if canonicalize_name(line.split("==")[0]) not in bounded]
        PINS.write_text("\n".join([*pins, *others, ""]))
        pip("install", "--no-compile", "-c", PINS, f"{wheel}[{','.join(EXTRAS)}]")
        print(f"The planner's wheel is tested with {', '.join(pins)}.", file=sys.stderr)
        (HOME / "environment").write_text(environment)
    else:
        pip("install", "--no-deps", "--force-reinstall", build_wheel())
    (HOME / "content").write_text(content)


def build_wheel() -> Path:
    """Build the wheel of the planner from a copy, because setuptools leaves files next to the sources."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "planner"
        shutil.copytree(SOURCES, copy, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
        shutil.rmtree(HOME / "wheel", ignore_errors=True)
        pip("wheel", "--no-deps", "--no-build-isolation", "-w", HOME / "wheel", copy)
    (wheel,) = (HOME / "wheel").glob("*.whl")
    return wheel


def lowest_versions(wheel: Path) -> list[str]:
    """Install every dependency with a lower bound at its lowest version; return the pins."""
    (folder,) = (path for path in ZipPath(wheel).iterdir() if path.name.endswith(".dist-info"))
    pins = []
    for text in PathDistribution(folder).requires or []:  # type: ignore[arg-type]  # a zipfile.Path works, too
        requirement = Requirement(text)
        applies = requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in EXTRAS)
        if applies and any(part.operator == ">=" for part in requirement.specifier):
            pins.append(install_lowest(requirement))
    return pins


def install_lowest(requirement: Requirement) -> str:
    """Install the lowest version that a requirement allows and that has a binary for this Python; return the pin."""
    listed = re.search(r"Available versions: (.+)", pip("index", "versions", requirement.name))
    assert listed is not None
    for version in sorted(requirement.specifier.filter(map(Version, listed[1].split(", ")))):
        pin = f"{requirement.name}=={version}"
        try:
            pip("install", "--no-compile", "--no-deps", "--only-binary", ":all:", pin)
        except UnreachableError:
            raise
        except InstallError:
            continue  # no binary for this Python
        return pin
    raise InstallError(f"no version of {requirement} has a binary for this Python.")


def pip(*arguments: str | Path) -> str:
    """Run pip in .venv-lowest; return its output."""
    return run(INTERPRETER, "-m", "pip", "--disable-pip-version-check", *arguments)


def run(*command: str | Path) -> str:
    """Run a command and return its output.

    Raises:
        InstallError: the command failed.
    """
    words = " ".join(map(str, command))
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        raise InstallError(f"{words}: {error.strerror or error}") from error
    if "connection broken by" in done.stderr and done.returncode:
        raise UnreachableError(
            "the package registry can't be reached; check the connection, or configure another one for pip."
        )
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        problem = next((line for line in lines if line.startswith("ERROR:")), lines[-1] if lines else "it failed")
        raise InstallError(f"{words}: {problem}")
    return done.stdout


def digest(files: list[Path], more: str) -> str:
    """Return a hash of `more` and of the names and content of files."""
    value = hashlib.sha256(more.encode())
    for file in files:
        value.update(f"{file.relative_to(ROOT)}\0".encode() + file.read_bytes())
    return value.hexdigest()


def stamp(name: str) -> str | None:
    """Return the content of a file in .venv-lowest, or None if it does not exist."""
    file = HOME / name
    return file.read_text() if file.exists() else None


if __name__ == "__main__":
    sys.exit(main())
