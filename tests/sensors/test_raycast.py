"""Rays compared with closed forms, and with sphere tracing in float64."""

import numpy as np
import pytest
import warp as wp

from aero_viz.scenes import World, scene
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.geometry import Geometry, world_distance
from aero_viz.sensors import cast


def make(**tables) -> World:
    return World(
        "", np.zeros(3), np.ones(3), mission=None, **{key: np.array(rows, dtype=float) for key, rows in tables.items()}
    )


def ranges(world: World, origin, directions, range_max=np.inf):
    directions = np.atleast_2d(np.asarray(directions, dtype=float))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = wp.array(np.atleast_2d(origin), dtype=wp.vec3)
    rays = wp.array(directions[None], dtype=wp.vec3)
    return cast(DeviceWorlds([world]), origins, rays, range_max=range_max).numpy()[0]


def march(world: World, origin, directions, range_max):
    """Sphere tracing in float64: a step by the distance to the nearest surface never crosses one."""
    travelled = np.zeros(len(directions))
    open_ = np.ones(len(directions), dtype=bool)
    for _ in range(4000):
        step = world.distance(origin + travelled[open_, None] * directions[open_])
        travelled[open_] += np.maximum(step, 0.0)
        still = (step > 1e-6) & (travelled[open_] < range_max)
        open_[np.flatnonzero(open_)[~still]] = False
        if not open_.any():
            break
    return np.where(travelled < range_max, travelled, np.inf)


def agreement(found, expected):
    """Return the share of equal ranges; at silhouettes, rounding decides which of the two hits the edge."""
    return np.mean(np.isclose(found, expected, atol=2e-3) | (np.isinf(found) & np.isinf(expected)))


def random_directions(rng, count):
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_cylinder_side_caps_and_inside():
    world = make(cylinders=[[0, 0, 0, 0, 0, 1, 0.5, 2]])
    assert ranges(world, [5, 0, 1], [-1, 0, 0]) == pytest.approx(4.5)
    assert ranges(world, [0.2, 0.1, 5], [0, 0, -1]) == pytest.approx(3.0)  # along the axis
    assert ranges(world, [0.2, 0.1, -4], [0, 0, 1]) == pytest.approx(4.0)
    assert ranges(world, [-2, 0, 4], [1, 0, -1]) == pytest.approx(2.0 * np.sqrt(2.0))  # the rim's height, at the centre
    assert ranges(world, [0.6, 0, 5], [0, 0, -1]) == np.inf
    assert ranges(world, [5, 0, 2.001], [-1, 0, 0]) == np.inf
    assert ranges(world, [5, 0, 1], [1, 0, 0]) == np.inf  # behind
    assert ranges(world, [0.1, 0, 1], [1, 0, 0]) == 0.0  # from inside


@pytest.mark.parametrize("offset", [0.0599, 0.0601])
def test_thin_cylinder_at_a_grazing_angle_forty_metres_away(offset):
    # A radius of 0.06 m, passed at 0.1 mm inside and outside its edge.
    world = make(cylinders=[[40, 0, -5, 0, 0, 1, 0.06, 10]])
    hit = ranges(world, [0, offset, 0], [1, 0, 0])[0]
    if offset > 0.06:
        assert hit == np.inf
    else:
        assert hit == pytest.approx(40.0 - np.sqrt(0.06**2 - offset**2), abs=2e-4)


def test_ray_almost_along_a_long_cylinder():
    # It enters the side where the height has grown by the missing 0.1 m.
    world = make(cylinders=[[0, 0, 0, 1, 0, 0, 0.5, 100]])
    slope = 1e-3
    direction = np.array([1.0, 0.0, -slope])
    expected = 100.0 * np.sqrt(1 + slope**2)
    assert ranges(world, [-50, 0, 0.6], direction)[0] == pytest.approx(expected, abs=1e-2)


def test_box_with_yaw():
    world = make(boxes=[[5, 0, 0, 2, 2, 2, np.pi / 4]])
    assert ranges(world, [0, 0, 0], [1, 0, 0]) == pytest.approx(5.0 - np.sqrt(2.0), abs=1e-5)
    assert ranges(world, [0, 1.40, 0], [1, 0, 0]) == pytest.approx(5.0 - (np.sqrt(2.0) - 1.40), abs=1e-4)
    assert ranges(world, [0, 1.42, 0], [1, 0, 0]) == np.inf


def test_sphere_and_ground():
    world = make(spheres=[[10, 0, 2, 1]], boxes=[[0, 0, -0.5, 200, 200, 1, 0]])
    assert ranges(world, [0, 0, 2], [1, 0, 0]) == pytest.approx(9.0)
    assert ranges(world, [0, 0, 2], [0, 1, -1]) == pytest.approx(2.0 * np.sqrt(2.0))
    assert ranges(world, [0, 0, 2], [1, 0, 0], range_max=8.9) == np.inf


def test_empty_world_returns_nothing():
    assert np.all(np.isinf(ranges(make(), [0, 0, 0], np.eye(3))))


def test_rays_that_are_not_finite_return_nothing():
    world = make(spheres=[[5, 0, 0, 1]], triangles=[[4, -1, -1, 4, 1, -1, 4, 0, 1]])
    directions = [[1.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]
    rays, here, nowhere = wp.array([directions], dtype=wp.vec3), [[0.0, 0.0, 0.0]], [[0.0, np.nan, 0.0]]
    worlds = DeviceWorlds([world])
    np.testing.assert_allclose(cast(worlds, wp.array(here, dtype=wp.vec3), rays).numpy()[0], [4.0, np.inf, np.inf])
    assert np.isinf(cast(worlds, wp.array(nowhere, dtype=wp.vec3), rays).numpy()).all()


@pytest.mark.parametrize("name", ["forest", "verticals", "inclines"])
@pytest.mark.parametrize("origin", [[0.0, 0.0, 2.0], [-20.0, 3.0, 9.0], [45.0, 0.0, 2.0]])
def test_scene_matches_the_float64_reference(name, origin):
    world = scene(name, seed=3, count=60)
    directions = random_directions(np.random.default_rng(1), 1500)
    expected = march(world, np.array(origin), directions, 40.0)
    found = ranges(world, origin, directions, range_max=40.0)
    assert agreement(found, expected) > 0.997
    assert np.isfinite(found).mean() > 0.1


def test_scattered_primitives_of_all_kinds_match_the_reference():
    rng = np.random.default_rng(2)
    world = make(
        cylinders=np.column_stack(
            [
                rng.uniform(-30, 30, (40, 3)),
                random_directions(rng, 40),
                rng.uniform(0.05, 1, 40),
                rng.uniform(0.2, 9, 40),
            ]
        ),
        boxes=np.column_stack([rng.uniform(-30, 30, (40, 3)), rng.uniform(0.1, 6, (40, 3)), rng.uniform(-4, 4, 40)]),
        spheres=np.column_stack([rng.uniform(-30, 30, (40, 3)), rng.uniform(0.05, 2, 40)]),
    )
    directions = random_directions(rng, 4000)
    origin = np.array([1.0, 2.0, 40.0])
    expected = march(world, origin, directions, 100.0)
    found = ranges(world, origin, directions, range_max=100.0)
    assert agreement(found, expected) > 0.997


def test_axis_parallel_rays_in_the_grid():
    world = scene("verticals", seed=0, count=200, ground=False)
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    origin = np.array([0.0, 0.0, 2.0])
    np.testing.assert_allclose(
        ranges(world, origin, directions, 60.0), march(world, origin, directions, 60.0), atol=1e-3
    )


def test_obstacles_far_apart_share_a_bounded_grid():
    world = make(spheres=[[0, 0, 0, 1], [20_000, 0, 0, 5], [0, 30_000, 0, 5]])
    worlds = DeviceWorlds([world])
    assert worlds.geometry.cells.shape[0] < 200_000
    found = ranges(world, [10_000, 0, 0], [[1, 0, 0], [-1, 0, 0]])
    np.testing.assert_allclose(found, [9_995.0, 9_999.0], rtol=1e-6)


@pytest.fixture
def voxel_map() -> World:
    """A floor, a wall and scattered voxels: small boxes, too many for columns."""
    rng = np.random.default_rng(5)
    scattered = np.floor(rng.uniform([-20, -20, 0], [20, 20, 6], (4000, 3)) / 0.2)
    floor = np.stack(np.meshgrid(np.arange(-40, 40), np.arange(-40, 40), [-1]), axis=-1).reshape(-1, 3)
    voxels = np.unique(np.vstack([scattered, floor]), axis=0)
    rows = np.column_stack([0.2 * (voxels + 0.5), np.full((len(voxels), 3), 0.2), np.zeros(len(voxels))])
    return make(boxes=[*rows, [12.0, 0.0, 2.0, 0.2, 30.0, 4.0, 0.3]])


def test_cubes_match_the_float64_reference(monkeypatch):
    monkeypatch.setattr("aero_viz.scenes.device_worlds.COLUMNS_PRIMITIVES_MAX", 0)
    rng = np.random.default_rng(3)
    places = rng.uniform([-6, -6, 0], [6, 6, 5], (250, 3))
    world = make(boxes=np.column_stack([places, rng.uniform(0.1, 0.6, (250, 3)), rng.uniform(-3, 3, 250)]))
    assert DeviceWorlds([world]).geometry.grids.numpy()["layers"][0] > 3
    for origin in ([0.0, 0.0, 2.0], [-12.0, 3.0, 9.0]):
        directions = rng.uniform([-6, -6, 0], [6, 6, 5], (800, 3)) - origin
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        expected = march(world, np.array(origin), directions, 60.0)
        found = ranges(world, origin, directions, range_max=60.0)
        assert agreement(found, expected) > 0.997 and np.isfinite(found).mean() > 0.3


def test_cubes_and_columns_find_the_same_hits(voxel_map, monkeypatch):
    directions = np.vstack([random_directions(np.random.default_rng(2), 20_000), np.eye(3), -np.eye(3)])
    origin = [1.0, 0.5, 2.0]
    assert DeviceWorlds([voxel_map]).geometry.grids.numpy()["layers"][0] > 5
    in_cubes = ranges(voxel_map, origin, directions, range_max=40.0)
    monkeypatch.setattr("aero_viz.scenes.device_worlds.COLUMNS_PRIMITIVES_MAX", 1_000_000)
    assert DeviceWorlds([voxel_map]).geometry.grids.numpy()["layers"][0] == 1
    np.testing.assert_array_equal(ranges(voxel_map, origin, directions, range_max=40.0), in_cubes)


def test_every_flight_sees_its_own_world():
    near, far = make(spheres=[[5, 0, 0, 1]]), make(spheres=[[9, 0, 0, 1]])
    worlds = DeviceWorlds([near, far, make(), near])
    origins = wp.zeros(4, dtype=wp.vec3)
    directions = wp.array(np.tile([1.0, 0.0, 0.0], (4, 1, 1)), dtype=wp.vec3)
    np.testing.assert_allclose(cast(worlds, origins, directions).numpy()[:, 0], [4.0, 8.0, np.inf, 4.0])


def test_rays_that_are_not_finite_hit_nothing():
    worlds = DeviceWorlds([scene("forest", seed=1, count=40)])
    rays = [[np.nan, np.nan, np.nan], [np.inf, 0.0, 0.0], [0.0, -np.inf, 0.0], [0.0, 0.0, 0.0]]
    found = cast(worlds, wp.zeros(1, dtype=wp.vec3), wp.array([rays], dtype=wp.vec3)).numpy()
    assert np.isinf(found[:, :3]).all()
    lost = wp.array([[np.nan, 0.0, 0.0]], dtype=wp.vec3)
    assert np.isinf(cast(worlds, lost, wp.array([[[1.0, 0.0, 0.0]]], dtype=wp.vec3)).numpy()).all()


@wp.kernel
def distance_kernel(
    geometry: Geometry,  # pyright: ignore[reportGeneralTypeIssues]
    points: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=float),
):
    i = wp.tid()
    found[i] = world_distance(geometry, 0, points[i], 0.0, 0, 1)


def test_device_distance_matches_numpy():
    world = scene("forest", seed=1, count=40)
    points = np.random.default_rng(0).uniform([0, -20, -1], [45, 20, 9], (2000, 3))
    found = wp.zeros(2000)
    worlds = DeviceWorlds([world])
    wp.launch(distance_kernel, 2000, [worlds.geometry, wp.array(points, dtype=wp.vec3)], [found])
    np.testing.assert_allclose(found.numpy(), world.distance(points), atol=2e-5)
