import numpy as np
import pytest

from aero_viz.catalog import load_world, open_source
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.recordings import open_recording
from aero_viz.scenes import load_map
from aero_viz.scenes.passable import is_passable


def save(path, points) -> str:
    np.save(path, np.asarray(points, dtype=np.float64))
    return str(path)


@pytest.fixture
def hall(tmp_path) -> str:
    """Floor at z = -1.5, 60 m x 20 m, and a wall at x = 20 that leaves a gate at y = 5 .. 8."""
    x, y = np.meshgrid(np.arange(-10.0, 50.0, 0.1), np.arange(-10.0, 10.0, 0.1), indexing="ij")
    floor = np.stack([x, y, np.full_like(x, -1.5)], axis=-1).reshape(-1, 3)
    y, z = np.meshgrid(np.arange(-10.0, 10.0, 0.1), np.arange(-1.5, 6.0, 0.1), indexing="ij")
    wall = np.stack([np.full_like(y, 20.05), y, z], axis=-1).reshape(-1, 3)
    wall = wall[(wall[:, 1] < 5.0) | (wall[:, 1] > 8.0)]
    return save(tmp_path / "hall.npy", np.vstack([floor, wall]))


def contains(boxes, points):
    return np.all(np.abs(points[:, None, :] - boxes[None, :, :3]) <= 0.5 * boxes[None, :, 3:6] + 1e-9, axis=2)


def test_boxes_fill_exactly_the_occupied_voxels(tmp_path):
    points = np.random.default_rng(0).uniform(0.0, 2.0, (300, 3))
    path = save(tmp_path / "cloud.npy", points)
    world = load_map(path, voxel=0.25, start=[0, 0, 5], goal=[5, 0, 5])
    occupied = np.unique(np.floor(points / 0.25), axis=0)
    centres = 0.25 * (np.stack(np.meshgrid(*[np.arange(-1, 10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5)
    inside = contains(world.boxes, centres).sum(axis=1)
    expected = (np.floor(centres / 0.25)[:, None] == occupied).all(axis=2).any(axis=1)
    np.testing.assert_array_equal(inside, expected.astype(int))  # each voxel in exactly one box
    assert len(world.boxes) < len(occupied)


def test_a_full_wall_becomes_one_box(tmp_path):
    y, z = np.meshgrid(np.arange(0.05, 3.0, 0.1), np.arange(0.05, 2.0, 0.1))
    path = save(tmp_path / "wall.npy", np.stack([np.full_like(y, 1.05), y, z], axis=-1).reshape(-1, 3))
    world = load_map(path, voxel=0.1, start=[0, 0, 1], goal=[5, 0, 1])
    np.testing.assert_allclose(world.boxes, [[1.05, 1.5, 1.0, 0.1, 3.0, 2.0, 0.0]], atol=1e-9)
    assert world.name == "wall"


def test_default_start_and_goal(hall):
    world = load_map(hall)
    # 2 m over the floor at z = -1.5; near the origin, and as far as 45 m allow, through the gate.
    assert world.start[2] == pytest.approx(0.5, abs=0.3) and world.goal[2] == pytest.approx(0.5, abs=0.3)
    assert np.linalg.norm(world.start[:2]) < 2.0
    assert 43.0 < np.linalg.norm(world.goal - world.start) <= 45.0
    assert world.distance([world.start, world.goal]).min() >= 0.75
    assert is_passable(world, radius=0.5)


def test_default_goal_is_reachable_when_the_wall_is_closed(hall, tmp_path):
    points = np.load(hall)
    y, z = np.meshgrid(np.arange(4.5, 8.5, 0.1), np.arange(-1.5, 8.0, 0.1), indexing="ij")
    gate = np.stack([np.full_like(y, 20.05), y, z], axis=-1).reshape(-1, 3)
    # Closed up to the highest point of the search: 2 m over the map.
    y, z = np.meshgrid(np.arange(-10.0, 10.0, 0.1), np.arange(6.0, 8.0, 0.1), indexing="ij")
    top = np.stack([np.full_like(y, 20.05), y, z], axis=-1).reshape(-1, 3)
    roof = np.array([[x, y, 8.0] for x in np.arange(-10.0, 50.0, 0.2) for y in np.arange(-10.0, 10.0, 0.2)])
    world = load_map(save(tmp_path / "closed.npy", np.vstack([points, gate, top, roof])))
    assert world.goal[0] < 20.0


def test_explicit_start_and_goal_are_kept(hall):
    world = load_map(hall, start=[1.0, 2.0, 1.0], goal=[9.0, 3.0, 1.0])
    np.testing.assert_array_equal([world.start, world.goal], [[1, 2, 1], [9, 3, 1]])
    only_goal = load_map(hall, goal=[-5.0, 0.0, 1.0])
    np.testing.assert_array_equal(only_goal.goal, [-5.0, 0.0, 1.0])
    assert 40.0 < np.linalg.norm(only_goal.start - only_goal.goal) < 50.0


def test_geographic_coordinates_move_to_the_origin(hall, tmp_path):
    far = save(tmp_path / "far.npy", np.add(np.load(hall), [500_000.0, 4_000_000.0, 300.0]))
    world = load_map(far, start=[500_000.0, 4_000_000.0, 300.5], goal=[500_009.0, 4_000_000.0, 300.5])
    np.testing.assert_allclose(world.start, [10.0, 10.0, 2.5], atol=1.0)
    np.testing.assert_allclose(world.goal - world.start, [9.0, 0.0, 0.0], atol=1e-6)
    assert np.abs(world.boxes[:, :3]).max() < 100.0


@pytest.mark.parametrize(
    ("options", "expected"),
    [({"voxel": 0.0}, "must be in"), ({"start": [0.0, 1.0]}, "start"), ({"goal": [0.0, 1.0, np.inf]}, "goal")],
)
def test_invalid_arguments_are_refused(hall, options, expected):
    with pytest.raises(UserError, match=expected):
        load_map(hall, **options)


def test_a_map_without_free_space_is_refused(tmp_path):
    grid = np.stack(np.meshgrid(*[np.arange(0.0, 4.0, 0.2)] * 3), axis=-1).reshape(-1, 3)
    with pytest.raises(UserError, match="give --start and --goal to demo or fly"):
        load_map(save(tmp_path / "solid.npy", grid), voxel=0.4)


def test_a_map_that_is_too_wide_is_refused_with_the_number_of_stray_points(hall, tmp_path):
    points = np.vstack([np.load(hall), [[99_000.0, 0.0, 0.0]]])
    with pytest.raises(UserError, match=r"stray.npy spans 99\.01 km along x, and at most .*; 1 of its \d+ points"):
        load_map(save(tmp_path / "stray.npy", points))


@pytest.mark.parametrize("place", [1e11, -1e300])
def test_a_map_or_cloud_whose_coordinates_have_lost_their_digits_is_refused(hall, tmp_path, place):
    far = save(tmp_path / "far.npy", np.load(hall) + np.array([0.0, place, 0.0]))
    for read in (load_map, open_recording):
        with pytest.raises(UserError, match=r"far.npy lies at y = .* move it to its origin"):
            read(far)


def test_a_map_of_too_many_voxels_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("aero_viz.scenes.maps.MAP_VOXELS_MAX", 1000)
    points = np.random.default_rng(0).uniform(0.0, 20.0, (3000, 3))
    with pytest.raises(UserError, match=r"many.npy fills 2\d+ voxels of 0.2 m, and at most 1000 .*--voxel"):
        load_map(save(tmp_path / "many.npy", points))


def test_a_real_map_becomes_a_world(shared_datasets):
    path = str(shared_datasets / "livox_mid40_surf.pcd")
    world = load_world(path)
    assert 5_000 < len(world.boxes) < 40_000  # of 91 531 points
    assert np.linalg.norm(world.start[:2]) < 10.0 and is_passable(world)
    with pytest.raises(UserError, match="--count"):
        load_world(path, count=3)


def test_a_map_opens_as_a_flight(hall):
    source = open_source(hall, lidar="mid360")
    assert isinstance(source, FlightSource) and source.info.name == "hall" and source.outcome is None
    points = source.observe().points
    assert len(points) > 5_000
    assert source.info.world is not None
    assert np.abs(source.info.world.distance(points)).max() < 0.15  # six times the range noise
