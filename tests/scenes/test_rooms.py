import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import double_wall_trap, pillars, random_clutter, scene, wall
from aero_viz.scenes.passable import is_passable
from aero_viz.scenes.rooms import LOWER, UPPER

ROOMS = ("pillars", "wall", "double_wall_trap", "random_clutter")
# Where the room is, seen from above: nobody goes around its own walls.
INSIDE = [LOWER, UPPER]


def line(world, end, count=400):
    share = np.linspace(0.0, 1.0, count)[:, None]
    return world.start + share * (np.asarray(end) - world.start)


@pytest.mark.parametrize("name", ROOMS)
def test_rooms_block_the_direct_line_and_are_passable(name):
    for seed in range(8):
        world = scene(name, seed=seed)
        np.testing.assert_array_equal([world.start, world.goal], [[0, 0, 0.8], [3.75, 0, 0.8]])
        assert world.distance(line(world, world.goal)).min() < 0.25
        assert is_passable(world, radius=0.25, cell=0.05, region=INSIDE)


@pytest.mark.parametrize("name", ROOMS)
@pytest.mark.parametrize(
    "end", [[9.0, 0.0, 0.8], [-9.0, 0.0, 0.8], [0.0, 9.0, 0.8], [0.0, -9.0, 0.8], [0.0, 0.0, -9.0]]
)
def test_rooms_are_closed_around_and_below(name, end):
    world = scene(name, seed=2)
    assert world.distance(line(world, end)).min() < 0.0


def test_trap_cannot_be_flown_over():
    world = double_wall_trap(seed=3)
    assert world.distance(line(world, [0.0, 0.0, 9.0])).min() < 0.0  # a ceiling
    # Straight ahead at every height up to it.
    for height in np.arange(0.05, 1.6, 0.05):
        assert world.distance([[x, 0.0, height] for x in np.arange(0.0, 3.75, 0.02)]).min() < 0.0
    assert world.bounds[1, 2] == 1.6


def test_passages_of_the_trap_lie_on_opposite_sides():
    sides = set()
    for seed in range(10):
        first, second = double_wall_trap(seed=seed).boxes[:2]
        assert first[1] * second[1] < 0.0 and 1.2 <= second[0] - first[0] <= 1.5
        for box in (first, second):
            assert 0.8 <= 4.0 - box[4] <= 1.1
            assert abs(box[1]) + 0.5 * box[4] == pytest.approx(2.0)
        sides.add(np.sign(first[1]))
    assert sides == {-1.0, 1.0}


def test_a_ceiling_is_an_option_of_every_room():
    for room in (pillars, wall, random_clutter):
        open_above, closed = room(seed=1), room(seed=1, ceiling=2.0)
        top = line(open_above, [0.0, 0.0, 9.0])
        assert open_above.distance(top).min() > 0.0 > closed.distance(top).min()


def test_pillars_are_apart():
    world = pillars(seed=5)
    assert len(world.cylinders) == 6
    apart = np.linalg.norm(world.cylinders[:, None, :2] - world.cylinders[None, :, :2], axis=-1)
    gap = apart - world.cylinders[:, None, 6] - world.cylinders[None, :, 6]
    assert gap[~np.eye(6, dtype=bool)].min() >= 0.6


def test_clutter_has_boxes_poles_and_balls():
    world = random_clutter(seed=0, count=6)
    walls = 5
    assert (len(world.boxes) - walls, len(world.cylinders), len(world.spheres)) == (2, 2, 2)


@pytest.mark.parametrize("room", [pillars, random_clutter])
def test_too_many_obstacles_for_the_room(room):
    with pytest.raises(UserError, match="ask for fewer"):
        room(seed=0, count=60)


def test_a_ceiling_below_the_clear_height_is_refused():
    with pytest.raises(UserError, match="ceiling is at"):
        wall(seed=0, ceiling=1.0)
