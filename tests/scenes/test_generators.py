import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import SCENES, World, density, forest, inclines, scene, verticals
from aero_viz.scenes.field import AREA
from aero_viz.scenes.passable import is_passable

OUTDOOR = ("forest", "verticals", "inclines", "density", "density-6m")
COUNTED = [name for name, kind in SCENES.items() if kind.counted]


def tables(world: World):
    parts = (world.cylinders, world.boxes, world.spheres, world.triangles, world.motion)
    return np.concatenate([table.ravel() for table in parts])


@pytest.mark.parametrize("name", SCENES)
def test_same_seed_same_world(name):
    first, repeated, different = (scene(name, seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(tables(first), tables(repeated))
    assert not np.array_equal(tables(first), tables(different))


@pytest.mark.parametrize("name", SCENES)
def test_start_and_goal_are_clear(name):
    for seed in range(3):
        world = scene(name, seed=seed, ground=False)
        assert world.distance([world.start, world.goal]).min() >= SCENES[name].clear_radius


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["wires", "branches", "crowns", "blocks", "windows", "hall", "slope", "mixture"])
def test_scenes_that_are_no_fields_of_trunks_are_passable(name, seed):
    # The ground of the slope reaches beyond the trees: the path must not lead around them.
    assert is_passable(scene(name, seed=seed), radius=0.4, region=np.transpose(AREA))


@pytest.mark.parametrize("name", SCENES)
def test_json_round_trip(name, tmp_path):
    world = scene(name, seed=1)
    world.save(tmp_path / "w.json")
    loaded = World.load(tmp_path / "w.json")
    np.testing.assert_array_equal(tables(loaded), tables(world))
    np.testing.assert_array_equal(loaded.bounds, world.bounds)
    assert loaded.name == world.name


@pytest.mark.parametrize("name", OUTDOOR)
def test_obstacles_stand_in_the_area(name):
    world = scene(name, seed=1, ground=False)
    assert SCENES[name].clear_radius == 2.5
    base = world.cylinders[:, :3]
    assert np.all((base[:, 0] >= 2.5) & (base[:, 0] <= 42.5) & (np.abs(base[:, 1]) <= 20.0) & (base[:, 2] == 0.0))
    np.testing.assert_array_equal([world.start, world.goal], [[0, 0, 2], [45, 0, 2]])


def test_forest_has_trunks_under_canopies():
    world = forest(seed=2)
    assert (len(world.cylinders), len(world.spheres)) == (100, 400)
    assert np.degrees(np.arccos(world.cylinders[:, 5])).max() <= 15.0
    assert (world.spheres[:, 2] - world.spheres[:, 3]).min() >= 3.0 - 1e-9


def test_widths_of_verticals_are_diameters():
    cylinders = verticals(seed=0).cylinders
    assert len(cylinders) == 1000
    assert 0.2 <= cylinders[:, 6].min() < 0.21 and 0.54 < cylinders[:, 6].max() <= 0.55
    assert np.all(cylinders[:, 5] == 1.0) and np.all(cylinders[:, 7] == 6.0)


def test_inclines_lean():
    cylinders = inclines(seed=0).cylinders
    assert len(cylinders) == 800
    tilt = np.degrees(np.arccos(cylinders[:, 5]))
    assert 28.0 < tilt.max() <= 30.0 and tilt.min() < 1.0
    np.testing.assert_allclose(np.linalg.norm(cylinders[:, 3:6], axis=1), 1.0, atol=1e-12)


def test_density_has_random_or_fixed_heights_of_the_same_cylinders():
    varied, fixed = (density(seed=3, count=400, height=height).cylinders for height in ((1.0, 6.0), (6.0, 6.0)))
    assert 1.0 <= varied[:, 7].min() < 1.1 and 5.9 < varied[:, 7].max() <= 6.0
    assert np.all(fixed[:, 7] == 6.0) and np.all(fixed[:, 5] == 1.0)
    # A start or goal that a short cylinder leaves clear may refuse a tall one: all but a few stand in both.
    np.testing.assert_array_equal(varied[:100, :7], fixed[:100, :7])
    assert scene("density-6m", seed=3, count=7).name == "density-6m-7-3"
    assert scene("density", seed=3, count=7).name == "density-7-3"


@pytest.mark.parametrize("name", SCENES)
def test_ground_is_an_option(name):
    with_ground, without = (scene(name, seed=0, ground=ground) for ground in (True, False))
    assert with_ground.ground.sum() == 1 and not without.ground.any()
    (ground,) = with_ground.boxes[with_ground.ground]
    assert ground[2] + 0.5 * ground[5] == 0.0
    np.testing.assert_array_equal(with_ground.cylinders, without.cylinders)
    np.testing.assert_array_equal(with_ground.boxes[~with_ground.ground], without.boxes)


PRIMITIVES_OF_FOUR = {
    "forest": 4 * 5, "long_forest": 4 * 5, "slope": 4 * 5, "wires": 4 * 3, "branches": 4 * 13, "windows": 4 * 10,
    "crowns": 4 * 6 + 2, "mixture": 3 + 5 + 13 + 6,
}  # fmt: skip
"""Primitives of four obstacles, where an obstacle has several."""


@pytest.mark.parametrize("name", COUNTED)
def test_count_is_the_number_of_obstacles_and_may_be_zero(name):
    none, four = (scene(name, seed=0, count=count, ground=False) for count in (0, 4))
    added = [len(getattr(four, key)) - len(getattr(none, key)) for key in ("cylinders", "boxes", "spheres")]
    assert sum(added) == PRIMITIVES_OF_FOUR.get(name, 4)


@pytest.mark.parametrize("name", sorted(set(SCENES) - set(COUNTED)))
def test_scenes_of_fixed_count_refuse_a_count(name):
    with pytest.raises(UserError, match="leave the count out"):
        scene(name, seed=0, count=3)


def test_unknown_scene_suggests_the_closest_name():
    with pytest.raises(UserError, match=r"did you mean 'forest'\?\); give one of"):
        scene("forrest", seed=0)


@pytest.mark.parametrize("options", [{"seed": -1}, {"seed": 0, "count": -3}])
def test_negative_numbers_are_refused(options):
    with pytest.raises(UserError, match="must be 0 or more"):
        scene("forest", **options)


def test_a_count_that_would_take_minutes_is_refused():
    with pytest.raises(UserError, match="must be at most 20000"):
        scene("forest", count=1_000_000)


@pytest.mark.parametrize(("name", "fastest"), [("moving", 2.0), ("fast_moving", 6.0)])
def test_moving_pillars_never_come_near_start_and_goal(name: str, fastest: float):
    world = scene(name, seed=3, count=60, ground=False)
    speeds = np.linalg.norm(world.motion[:, :2], axis=1)
    assert world.name == f"{name}-60-3" and world.moves.all()
    assert speeds.min() >= 0.5 and 0.9 * fastest < speeds.max() <= fastest
    nearest = [world.at(time).distance([world.start, world.goal]).min() for time in np.arange(0.0, 60.0, 0.1)]
    assert min(nearest) >= 2.5 - 1e-9
