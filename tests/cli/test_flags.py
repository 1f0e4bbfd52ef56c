"""The configuration that flags describe, and what it is told of the world."""

from __future__ import annotations

from typing import Any

import pytest

from aero_viz.cli.flags import ConfigFlags, WorldFlags


def flags(config: str = "default", **costs: Any) -> ConfigFlags:
    planner = ConfigFlags().planner
    return ConfigFlags(config, type(planner)(costs=type(planner.costs)(**costs)))


@pytest.mark.parametrize(
    ("given", "ground", "floor"),
    [
        (flags(), 0.0, 0.0),
        (flags("fast-cpu"), -2.5, -2.5),
        (flags(), None, -1000.0),
        (flags(floor=-1000.0), 0.0, -1000.0),
        (flags(floor=0.7), 0.0, 0.7),
        (flags("paper"), 0.0, -1000.0),
    ],
)
def test_presets_are_told_of_the_ground(given: ConfigFlags, ground: float | None, floor: float):
    assert given.load(ground).costs.floor == floor


def test_a_file_says_itself_where_the_floor_is(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("costs:\n  q_track: 7\n")
    assert flags(str(file)).load(0.0).costs.floor == -1000.0


def test_scenes_have_ground_and_recordings_none():
    assert WorldFlags().ground("forest", seed=0) == 0.0
    assert WorldFlags().ground("flight.mcap", seed=0) is None
