"""Fixtures for tests of the command line."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_source import small_source

from tests.cli.programs import StartPython


@pytest.fixture(scope="session")
def poles(tmp_path_factory: pytest.TempPathFactory) -> str:
    """World file with three poles and a goal 12 m away."""
    return _save_poles(tmp_path_factory, goal=12.0)


@pytest.fixture(scope="session")
def short_poles(tmp_path_factory: pytest.TempPathFactory) -> str:
    """World file with three poles and a goal 7 m away."""
    return _save_poles(tmp_path_factory, goal=7.0)


@pytest.fixture
def start_python() -> Iterator[StartPython]:
    """A function that starts a Python process. All processes are killed after the test."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, *arguments]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def _save_poles(tmp_path_factory: pytest.TempPathFactory, *, goal: float) -> str:
    world = small_source(goal=goal).info.world
    assert world is not None
    path: Path = tmp_path_factory.mktemp("worlds") / "poles.json"
    world.save(path)
    return str(path)
