import numpy as np
import pytest

from aero_viz.scenes import World, forest, scene
from aero_viz.scenes.field import AREA
from aero_viz.scenes.triangles import TriangleTree

DIAMETERS = (0.016, 0.04)
SEEDS = range(3)


def ends(cylinders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return cylinders[:, :3], cylinders[:, :3] + cylinders[:, 7:] * cylinders[:, 3:6]


def is_between(values: np.ndarray, bounds: tuple[float, float]) -> bool:
    return bool(np.all((values >= bounds[0] - 1e-9) & (values <= bounds[1] + 1e-9)))


def height_above_surface(world: World, points: np.ndarray) -> np.ndarray:
    """Return heights above the plane of the nearest triangle [m]."""
    _, rows = TriangleTree(world.triangles).nearest(points)
    a, b, c = np.moveaxis(world.triangles[rows].reshape(-1, 3, 3), 1, 0)
    normal = np.cross(b - a, c - a)
    assert np.all(normal[:, 2] > 0.0), "the surface is seen from above"
    return np.sum((points - a) * normal, axis=1) / normal[:, 2]


@pytest.mark.parametrize("seed", SEEDS)
def test_wires_are_thin_and_cross_the_field_between_posts_at_its_border(seed):
    parts = scene("wires", seed=seed).cylinders.reshape(-1, 3, 8)  # a wire and its two posts
    wires, posts = parts[:, 0], parts[:, 1:]
    assert len(wires) == 60 and is_between(2.0 * wires[:, 6], DIAMETERS)
    for k, end in enumerate(ends(wires)):
        assert is_between(end[:, 2], (0.5, 6.0))
        assert is_between(end[:, 0], AREA[0]) and is_between(end[:, 1], AREA[1])
        at_border = np.isclose(np.abs(end[:, 1]), 20.0) | np.isclose(end[:, 0], 2.5) | np.isclose(end[:, 0], 42.5)
        assert at_border.all()
        np.testing.assert_allclose(posts[:, k, :2], end[:, :2], atol=1e-9)
        assert np.all(posts[:, k, 7] >= end[:, 2]), "the wire is fixed to the post"


def test_wires_criss_cross_at_the_height_of_the_drone():
    wires = scene("wires", seed=0).cylinders[::3]
    heading = np.degrees(np.arctan2(wires[:, 4], wires[:, 3])) % 180.0
    assert np.ptp(np.histogram(heading, 4, (0.0, 180.0))[0]) < 20, "no direction is preferred"
    a, b = ends(wires)
    middle = 0.5 * (a + b)[:, 2]
    assert np.sum(np.abs(middle - 2.0) < 1.0) > 10


@pytest.mark.parametrize("seed", SEEDS)
def test_branches_are_thin_and_grow_from_their_trunk(seed):
    parts = scene("branches", seed=seed).cylinders.reshape(-1, 13, 8)  # a trunk and its branches
    assert len(parts) == 80
    trunk, branches = parts[:, 0], parts[:, 1:]
    assert is_between(2.0 * branches[..., 6], DIAMETERS) and is_between(branches[..., 7], (0.8, 2.2))
    assert np.all(branches[..., 5] >= 0.0), "no branch hangs down"
    relative = branches[..., :3] - trunk[:, None, :3]
    along = np.sum(relative * trunk[:, None, 3:6], axis=-1)
    across = np.linalg.norm(relative - along[..., None] * trunk[:, None, 3:6], axis=-1)
    assert across.max() < 1e-9 and along.min() >= 0.8 - 1e-9 and np.all(along <= trunk[:, None, 7] + 1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_crowns_float_at_the_height_of_the_drone_and_every_other_one_has_a_thin_trunk(seed):
    world = scene("crowns", seed=seed)
    spheres = world.spheres.reshape(80, 6, 4)
    assert len(world.cylinders) == 40 and is_between(world.cylinders[:, 6], (0.03, 0.06))
    assert np.all(spheres[..., 2] > spheres[..., 3]), "no crown touches the ground"
    assert is_between(spheres[..., 2].mean(axis=1), (1.0, 4.5))
    tops = ends(world.cylinders)[1]
    assert np.all(np.abs(tops - spheres[::2, :, :3].mean(axis=1)) < 1.0), "a trunk ends in its crown"


@pytest.mark.parametrize("seed", SEEDS)
def test_the_slope_rises_from_start_to_goal_and_its_trees_stand_in_it(seed):
    world = scene("slope", seed=seed)
    np.testing.assert_array_equal([world.start, world.goal], [[0, 0, 2], [45, 0, 10]])
    assert world.distance([world.start, world.goal]) == pytest.approx([2.0, 2.0], abs=0.1)
    corners = world.triangles.reshape(-1, 3)
    for x, height in ((2.5, 0.0), (65.0, 8.0)):
        np.testing.assert_allclose(corners[np.isclose(corners[:, 0], x), 2], height, atol=1e-9)
    assert corners[:, 2].min() >= -0.8 and corners[:, 2].max() <= 8.8
    heights = height_above_surface(world, world.cylinders[:, :3])
    assert heights.max() < -0.1 and heights.min() > -0.6
    canopy = height_above_surface(world, world.spheres[:, :3] - [0.0, 0.0, 1.0] * world.spheres[:, 3:])
    assert canopy.min() > 1.5


def test_the_surface_of_the_slope_is_a_part_of_the_ground():
    assert len(scene("slope", seed=0, ground=False).triangles) == 0


def test_the_trees_of_the_slope_are_those_of_the_forest():
    trunks, trees = scene("slope", seed=1).cylinders, forest(seed=1).cylinders
    for column, name in ((6, "radius"), (7, "height")):
        assert np.ptp(trunks[:, column]) == pytest.approx(np.ptp(trees[:, column]), rel=0.2), name
    assert np.degrees(np.arccos(trunks[:, 5])).max() <= 15.0


@pytest.mark.parametrize("seed", SEEDS)
def test_a_mixture_has_as_many_of_each_kind(seed):
    world = scene("mixture", seed=seed, ground=False)
    wires, trees, bare_trees, crowns, buildings, screens = [10] * 6
    assert len(world.cylinders) == 3 * wires + trees + 13 * bare_trees
    assert len(world.spheres) == 4 * trees + 6 * crowns
    assert len(world.boxes) == buildings + 4 * screens
