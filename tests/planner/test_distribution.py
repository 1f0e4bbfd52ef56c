"""Which planner is tested: the source, or by scripts/lowest.py the installed wheel with its lowest dependencies."""

from __future__ import annotations

import os
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import aero_planner

PINS = os.environ.get("AERO_PLANNER_PINS")
SOURCE = Path(__file__).parents[2] / "planner"


def test_the_planner_is_the_one_meant():
    home = Path(aero_planner.__file__).parent
    assert home.is_relative_to(sys.prefix if PINS else SOURCE)


@pytest.mark.skipif(not PINS, reason="these are not the lowest versions: make test-lowest")
def test_dependencies_are_the_lowest():
    pins = dict(line.split("==") for line in Path(PINS or "").read_text().split())
    bounded = [one for one in map(Requirement, metadata.requires("aero-planner") or []) if one.specifier]
    assert {"numpy", "warp-lang"} < {one.name for one in bounded}
    for one in bounded:
        assert metadata.version(one.name) == pins[one.name]
        # Exactly the bound, save where there is no binary for this Python.
        lowest = next(part.version for part in one.specifier if part.operator == ">=")
        assert one.name == "numpy" or f"{pins[one.name]}.".startswith(f"{lowest}.")
