"""The configuration that flags describe."""

from __future__ import annotations

from typing import Any

import pytest

from aero_viz.cli.flags import ConfigFlags


def flags(config: str = "default", **costs: Any) -> ConfigFlags:
    planner = ConfigFlags().planner
    return ConfigFlags(config, type(planner)(costs=type(planner.costs)(**costs)))


@pytest.mark.parametrize(
    ("given", "use_ground"),
    [
        (flags(), True),
        (flags("fast-cpu"), True),
        (flags(use_ground=False), False),
        (flags("paper"), False),
        (flags("paper", use_ground=True), True),
    ],
)
def test_only_the_paper_preset_ignores_the_ground(given: ConfigFlags, use_ground: bool):
    assert given.load().costs.use_ground == use_ground


def test_a_file_keeps_the_defaults_that_it_does_not_set(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("costs:\n  q_track: 7\n")
    assert flags(str(file)).load().costs.use_ground
