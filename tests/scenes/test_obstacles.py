"""Single solids of a world: what a ray meets first, and edits."""

import numpy as np
import pytest

from aero_viz.scenes import World
from aero_viz.scenes.obstacles import (
    KINDS,
    ObstacleKey,
    find_obstacle,
    identify,
    new_obstacle,
    obstacle_at,
    pick_obstacle,
    with_obstacle,
)


@pytest.fixture
def world() -> World:
    """A ground, a trunk that leans by 30 deg, a box and a sphere in a row along x."""
    return World.from_dict(
        {
            "name": "row",
            "start": [0, 0, 2],
            "goal": [20, 0, 2],
            "cylinders": [[4.0, 0.0, 0.0, 0.0, 0.5, 3**0.5 / 2, 0.5, 6.0]],
            "boxes": [[10, 0, -0.5, 60, 60, 1, 0], [8, 0, 2, 1, 2, 3, 0.3]],
            "spheres": [[12, 0, 2, 0.7]],
        }
    )


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ([-3, 1.2, 2], [1, 0, 0], ("cylinders", 0)),
        ([6, 0, 2], [1, 0, 0], ("boxes", 1)),
        ([20, 0.65, 2], [-1, 0, 0], ("spheres", 0)),
        ([20, 0.75, 2], [-1, 0, 0], ("boxes", 1)),
        ([6, 0, 2], [0, 0, -1], None),
        ([6, 0, 2], [0, 0, 1], None),
    ],
)
def test_a_ray_picks_the_first_solid_and_never_the_ground(world, origin, direction, expected):
    assert pick_obstacle(world, origin, direction) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_a_moved_or_resized_solid_is_where_it_says_and_the_others_stay(world, kind):
    key = ObstacleKey(KINDS[kind], len(getattr(world, KINDS[kind])) - 1)
    before = obstacle_at(world, key)
    assert before is not None
    moved = with_obstacle(world, before.moved([5.0, 6.0, 7.0]), key)
    after = obstacle_at(moved, key)
    assert (
        after is not None
        and after.center == pytest.approx([5.0, 6.0, 7.0])
        and after.size == pytest.approx(before.size)
    )
    assert moved.nearest([5.0, 6.0, 7.0])[1] == key.name
    assert world.distance(before.center[None])[0] < 0.0 < moved.distance(before.center[None])[0]
    deeper = before.resized(np.add(before.size, (0.0, 0.5, 0.0))).size - before.size
    assert deeper == pytest.approx(
        {"sphere": [0.5, 0.5, 0.5], "cylinder": [0.5, 0.5, 0.0], "box": [0.0, 0.5, 0.0]}[kind]
    )
    removed = with_obstacle(world, None, key)
    assert obstacle_at(removed, key) is None and removed.distance(before.center[None])[0] > 0.0
    np.testing.assert_array_equal(removed.bounds, world.bounds)


def test_a_new_solid_has_its_centre_and_size_and_a_cylinder_keeps_its_base(world):
    for kind in KINDS:
        new = new_obstacle(kind, [1.0, 2.0, 3.0], [0.4, 0.4, 0.4])
        assert new.center == pytest.approx([1.0, 2.0, 3.0]) and new.size == pytest.approx([0.4, 0.4, 0.4])
        name = f"{kind} {len(getattr(world, KINDS[kind]))}"
        assert with_obstacle(world, new).nearest([1.0, 2.0, 3.0]) == (pytest.approx(-0.2), name)
    trunk = new_obstacle("cylinder", [0.0, 0.0, 2.0], [1.0, 1.0, 4.0]).resized([1.0, 1.0, 6.0])
    assert trunk.center == pytest.approx([0.0, 0.0, 3.0])


def test_a_solid_keeps_its_identity_when_others_are_added_moved_and_removed(world):
    for i in range(3):
        world = with_obstacle(world, new_obstacle("box", [20.0 + i, 0, 2], [0.5, 0.5, 0.5]))
    key = ObstacleKey("boxes", 3)
    identity = identify(world, key)
    removed = with_obstacle(world, None, ObstacleKey("boxes", 2))
    assert find_obstacle(removed, identity) == ("boxes", 2) and find_obstacle(world, identity) == key
    gone = with_obstacle(removed, None, ObstacleKey("boxes", 2))
    again = with_obstacle(gone, new_obstacle("box", [21.0, 0, 2], [0.5, 0.5, 0.5]))
    assert find_obstacle(gone, identity) is None and find_obstacle(again, identity) is None
    moved = with_obstacle(removed, new_obstacle("box", [30, 0, 2], [1, 1, 1]), ObstacleKey("boxes", 2))
    assert find_obstacle(moved, identity) == ("boxes", 2)


def test_a_size_that_cannot_be_is_refused_by_name(world):
    with pytest.raises(ValueError, match=r'"spheres" row 0 has radius = -1'):
        with_obstacle(world, new_obstacle("sphere", [0, 0, 0], [-2, -2, -2]), ObstacleKey("spheres", 0))


def test_an_edit_keeps_the_motion_of_the_other_cylinders():
    pole = [4.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.5, 3.0]
    motion = np.array([[1.0, 0.0, 3.0], [0.0, 2.0, 4.0]])
    world = World("", np.zeros(3), np.ones(3), cylinders=np.array([pole, pole]), motion=motion)
    key, obstacle = ObstacleKey("cylinders", 0), new_obstacle("cylinder", [7.0, 0.0, 1.0], [1.0, 1.0, 2.0])
    np.testing.assert_array_equal(with_obstacle(world, obstacle).motion, [*motion, np.zeros(3)])
    np.testing.assert_array_equal(with_obstacle(world, None, key).motion, motion[1:])
    changed = with_obstacle(world, obstacle, key)
    np.testing.assert_array_equal(changed.motion, [np.zeros(3), motion[1]])
    np.testing.assert_array_equal(changed.at(9.0).cylinders[0], obstacle.values)
