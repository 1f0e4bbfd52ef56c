from pathlib import Path

import bags
import numpy as np
import pytest

from aero_viz.catalog import load_world, open_source
from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.scenes import World


def test_a_scene_opens_as_a_flight():
    source = open_source("forest", seed=3)
    assert source.info.closed_loop
    assert source.observe().points.shape[1] == 3
    source.close()


def test_a_saved_world_loads_unchanged(tmp_path: Path):
    world = load_world("forest", seed=4, count=7)
    path = tmp_path / "world.json"
    world.save(path)
    assert load_world(str(path)).to_dict() == world.to_dict()


@pytest.mark.parametrize(
    ("spec", "options", "message"),
    [
        ("forrest", {}, "forest"),
        ("", {}, "There is no scene ''; give one of forest"),
        ("no/such/world.json", {}, r"no/such/world\.json"),
        ("missing.mcap", {}, r"missing\.mcap"),
        ("forest", {"lidar": "mid361"}, "mid360"),
    ],
)
def test_errors_name_the_source_or_the_alternatives(spec: str, options: dict[str, str], message: str):
    with pytest.raises(UserError, match=message):
        open_source(spec, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("flight.mcap", r"flight\.mcap is not a world.*play it with: aero-viz play .*flight\.mcap"),
        ("folder", r"folder: Is a directory.*play it with: aero-viz play .*folder"),
        ("notes.txt", r"notes\.txt: it holds no rows of at least three numbers"),
        ("missing.mcap", r"There is no file .*missing\.mcap\.$"),
        ("missing.json", r"There is no file .*missing\.json\.$"),
    ],
)
def test_a_file_that_is_no_world_is_told_from_a_scene(monkeypatch, tmp_path: Path, file: str, message: str):
    (tmp_path / "folder").mkdir()
    (tmp_path / "flight.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "notes.txt").write_text("notes")
    monkeypatch.chdir(tmp_path)
    for path in (file, str(tmp_path / file)):
        with pytest.raises(UserError, match=message):
            load_world(path)


@pytest.mark.parametrize(("goal", "words"), [([4.0, 0.0, 2.0], None), ([9e4, 0.0, 2.0], "90000 m away")])
def test_a_world_is_refused_whose_goal_is_too_far_away_but_not_one_whose_goal_lies_in_an_obstacle(
    tmp_path: Path, goal: list[float], words: str | None
):
    path = tmp_path / "world.json"
    World("ball", np.array([0.0, 0.0, 2.0]), np.array(goal), spheres=np.array([[4.0, 0.0, 2.0, 1.0]])).save(path)
    if words is None:
        assert "lies inside an obstacle" in str(open_source(str(path)).explanation)
        return
    with pytest.raises(UserError, match=words):
        open_source(str(path))


def test_a_count_for_a_file_is_refused(tmp_path: Path):
    path = tmp_path / "world.json"
    load_world("forest", count=3).save(path)
    with pytest.raises(UserError, match="--count"):
        load_world(str(path), count=5)


@pytest.mark.parametrize("place", [[0, 0, 0], [500_000, 5_400_000, 300]])
def test_a_bag_with_a_single_cloud_is_a_world(tmp_path: Path, place: list[int]):
    ground = np.stack(np.meshgrid(np.arange(-20, 20, 0.2), np.arange(-20, 20, 0.2)), axis=-1).reshape(-1, 2)
    points = np.column_stack([ground, 0 * ground[:, 0]])
    points = np.vstack([points, [[5.0, 5.0, 0.2 * k] for k in range(20)]]) + place
    path = bags.write_mcap(tmp_path / "map.mcap", [bags.cloud(0, bags.xyz(points, "f8"), frame="map", topic="/map")])
    world = load_world(str(path), voxel=0.2)
    assert len(world.boxes) and np.abs(world.start).max() < 100
    if not any(place):
        with open_recording(path) as recording:
            assert any("aero-viz demo map.mcap" in text for text in recording.problems)
    many = bags.write_mcap(tmp_path / "many.mcap", [bags.cloud(0.1 * k, bags.xyz(points[:50])) for k in range(3)])
    with pytest.raises(UserError, match=r"has 3 clouds, and a map is a single one\. If it is a recording, play it"):
        load_world(str(many))
