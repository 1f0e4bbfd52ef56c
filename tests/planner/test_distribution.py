"""The tested planner: the source, or under scripts/lowest.py the installed wheel with its lowest dependencies."""

import os
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import aero_planner

PINS = os.environ.get("AERO_PLANNER_PINS")
SOURCE = Path(__file__).parents[2] / "planner"


def test_the_expected_planner_is_tested():
    home = Path(aero_planner.__file__).parent
    assert home.is_relative_to(sys.prefix if PINS else SOURCE)


@pytest.mark.skipif(not PINS, reason="these are not the lowest versions: make test-lowest")
def test_dependencies_are_the_lowest():
    pins = dict(line.split("==") for line in Path(PINS or "").read_text().split())
    requirements = map(Requirement, metadata.requires("aero-planner") or [])
    bounded = [requirement for requirement in requirements if requirement.specifier]
    assert {"numpy", "pyyaml", "warp-lang"} < {requirement.name for requirement in bounded}
    for requirement in bounded:
        name = requirement.name
        assert metadata.version(name) == pins[name]
        # Exactly the bound, unless there is no binary for this Python.
        lowest = next(part.version for part in requirement.specifier if part.operator == ">=")
        assert name == "numpy" or f"{pins[name]}.".startswith(f"{lowest}.")
