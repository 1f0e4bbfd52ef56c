from __future__ import annotations

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import SCENES, forest, inclines, scene, verticals


@pytest.mark.parametrize("name", SCENES)
def test_same_seed_same_world(name):
    first, again, other = (scene(name, seed=seed, count=30) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.cylinders, again.cylinders)
    np.testing.assert_array_equal(first.spheres, again.spheres)
    assert not np.array_equal(first.cylinders, other.cylinders)


@pytest.mark.parametrize("name", SCENES)
def test_start_and_goal_are_clear_and_obstacles_stand_in_the_area(name):
    world = scene(name, seed=1, ground=False)
    assert world.distance([world.start, world.goal]).min() >= 2.5
    base = world.cylinders[:, :3]
    assert np.all((base[:, 0] >= 2.5) & (base[:, 0] <= 42.5) & (np.abs(base[:, 1]) <= 20.0) & (base[:, 2] == 0.0))
    np.testing.assert_array_equal([world.start, world.goal], [[0, 0, 2], [45, 0, 2]])


def test_forest_is_trunks_under_canopies():
    world = forest(seed=2)
    assert (len(world.cylinders), len(world.spheres)) == (100, 400)
    assert np.degrees(np.arccos(world.cylinders[:, 5])).max() <= 15.0
    assert (world.spheres[:, 2] - world.spheres[:, 3]).min() >= 3.0 - 1e-9


def test_verticals_have_widths_as_diameters():
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


@pytest.mark.parametrize("name", SCENES)
def test_ground_is_an_option(name):
    with_ground, without = (scene(name, seed=0, count=5, ground=ground) for ground in (True, False))
    assert with_ground.ground.tolist() == [True] and len(without.boxes) == 0
    assert with_ground.boxes[0, 2] + 0.5 * with_ground.boxes[0, 5] == 0.0
    np.testing.assert_array_equal(with_ground.cylinders, without.cylinders)


@pytest.mark.parametrize("name", SCENES)
def test_count_may_be_zero(name):
    assert len(scene(name, seed=0, count=0).cylinders) == 0


def test_unknown_scene_suggests_the_nearest():
    with pytest.raises(UserError, match="Did you mean 'forest'"):
        scene("forrest", seed=0)


@pytest.mark.parametrize("options", [{"seed": -1}, {"seed": 0, "count": -3}])
def test_negative_numbers_are_refused(options):
    with pytest.raises(UserError, match="must be 0 or more"):
        scene("forest", **options)
