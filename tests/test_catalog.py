from __future__ import annotations

from pathlib import Path

import pytest

from aero_viz.catalog import load_world, open_source, source_choices
from aero_viz.errors import UserError


def test_every_choice_opens() -> None:
    choices = source_choices()
    assert "forest" in choices
    source = open_source("forest", seed=3)
    assert source.closed_loop
    assert source.observe().points.shape[1] == 3
    source.close()


def test_a_saved_world_is_the_same_world(tmp_path: Path) -> None:
    world = load_world("forest", seed=4, count=7)
    path = tmp_path / "world.json"
    world.save(path)
    assert load_world(str(path)).to_dict() == world.to_dict()


@pytest.mark.parametrize(
    ("spec", "options", "message"),
    [
        ("forrest", {}, "forest"),
        ("no/such/world.json", {}, r"no/such/world\.json"),
        ("missing.mcap", {}, r"missing\.mcap"),
        ("forest", {"lidar": "mid361"}, "mid360"),
    ],
)
def test_what_cannot_be_opened_is_told_with_the_way_out(spec: str, options: dict[str, str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_source(spec, **options)  # type: ignore[arg-type]


def test_a_count_for_a_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    load_world("forest", count=3).save(path)
    with pytest.raises(UserError, match="--count"):
        load_world(str(path), count=5)
