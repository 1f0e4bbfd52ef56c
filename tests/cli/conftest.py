"""Fixtures for tests of the command line."""

from pathlib import Path

import pytest
from small_source import small_source


@pytest.fixture(scope="session")
def poles(tmp_path_factory: pytest.TempPathFactory) -> str:
    """World file with three poles and a goal 12 m away."""
    return _save_poles(tmp_path_factory, goal=12.0)


@pytest.fixture(scope="session")
def short_poles(tmp_path_factory: pytest.TempPathFactory) -> str:
    """World file with three poles and a goal 7 m away."""
    return _save_poles(tmp_path_factory, goal=7.0)


def _save_poles(tmp_path_factory: pytest.TempPathFactory, *, goal: float) -> str:
    world = small_source(goal=goal).info.world
    assert world is not None
    path: Path = tmp_path_factory.mktemp("worlds") / "poles.json"
    world.save(path)
    return str(path)
