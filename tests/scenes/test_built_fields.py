import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.scenes import World, scene
from aero_viz.scenes.field import AREA
from aero_viz.scenes.passable import is_passable

SEEDS = range(3)


def corners(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return boxes[:, :3] - 0.5 * boxes[:, 3:6], boxes[:, :3] + 0.5 * boxes[:, 3:6]


def walls(world: World) -> list[np.ndarray]:
    """Return the boxes of each wall with windows."""
    return np.split(world.boxes[: 10 * ((len(world.boxes) - 4) // 10)], (len(world.boxes) - 4) // 10)


def openings(wall: np.ndarray, cell: float = 0.05) -> np.ndarray:
    """Return the mask of a grid over the wall's face, y by z, that its boxes leave open."""
    y, z = np.arange(-20.0 + 0.5 * cell, 20.0, cell), np.arange(0.5 * cell, 5.0, cell)
    is_open = np.ones((len(y), len(z)), dtype=bool)
    for low, high in zip(*corners(wall), strict=True):
        is_open[np.ix_((y > low[1]) & (y < high[1]), (z > low[2]) & (z < high[2]))] = False
    return is_open


@pytest.mark.parametrize("seed", SEEDS)
def test_a_wall_has_three_windows_of_1_6_m_and_no_other_opening(seed):
    world = scene("windows", seed=seed, ground=False)
    assert len(walls(world)) == 4
    for wall in walls(world):
        columns = openings(wall).sum(axis=1) * 0.05
        begins = np.flatnonzero(np.diff((columns > 0.0).astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff((columns > 0.0).astype(int), append=0) == -1) + 1
        assert len(begins) == 3
        np.testing.assert_allclose((ends - begins) * 0.05, 1.6, atol=0.051)
        np.testing.assert_allclose(columns[columns > 0.0], 1.6, atol=0.051)


@pytest.mark.parametrize("seed", SEEDS)
def test_windows_are_the_only_ways_through(seed):
    world = scene("windows", seed=seed)
    whole = np.array([[10.0, 0.0, 2.5, 0.2, 40.0, 5.0, 0.0]])
    closed = World("closed", world.start, world.goal, boxes=np.vstack([world.boxes, whole]), bounds=world.bounds)
    band, region = (0.0, 5.0), world.bounds[:, :2]
    for radius, expected in ((0.25, True), (0.7, True), (0.81, False)):
        assert is_passable(world, radius=radius, band=band, region=region) == expected, radius
    assert not is_passable(closed, radius=0.05, band=band, region=region)


@pytest.mark.parametrize("count", [1, 8])
def test_the_walls_with_windows_keep_their_distance(count):
    x = [wall[0, 0] for wall in walls(scene("windows", seed=2, count=count, ground=False))]
    assert len(x) == count and min(x) > AREA[0][0] and max(x) < AREA[0][1]
    assert np.all(np.diff(x) > 2.4)


def test_more_walls_than_the_field_holds_are_refused():
    with pytest.raises(UserError, match="holds 8 walls with windows, not 9; ask for fewer"):
        scene("windows", seed=0, count=9)


@pytest.mark.parametrize("seed", SEEDS)
def test_blocks_leave_streets_and_alleys(seed):
    buildings = scene("blocks", seed=seed, ground=False).boxes
    low, high = corners(buildings)
    assert len(buildings) > 15 and np.all(low[:, 2] == 0.0)
    assert np.all((high[:, 2] >= 4.0) & (high[:, 2] <= 12.0))
    assert low[:, 0].min() >= 2.5 and high[:, 0].max() <= 42.5 and np.abs([low[:, 1], high[:, 1]]).max() <= 20.0
    gap = np.maximum(low[:, None] - high[None], low[None] - high[:, None])
    rows_apart, neighbours = gap[..., 0] > 0.0, gap[..., 0] <= 0.0
    np.fill_diagonal(neighbours, False)
    assert gap[rows_apart][:, 0].min() >= 2.5 - 1e-9 and gap[neighbours][:, 1].min() >= 1.5 - 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_a_hall_is_closed_and_has_pillars_and_level_beams(seed):
    world = scene("hall", seed=seed)
    np.testing.assert_array_equal(world.bounds, [[-4.0, -20.0, -0.5], [49.0, 20.0, 6.0]])
    outside = [[-4.05, 0, 3], [49.05, 0, 3], [20, -20.05, 3], [20, 20.05, 3], [20, 0, 6.05], [20, 0, -0.05]]
    assert np.all(world.distance(outside) < 0.0), "walls, roof and floor close it"

    boxes = world.boxes[:-6]  # without the outer walls, the roof and the floor
    is_square = boxes[:, 3] == boxes[:, 4]
    assert len(world.cylinders) + is_square.sum() == 64
    assert np.all(world.cylinders[:, 7] == 6.0) and np.all(boxes[is_square, 5] == 6.0)
    beams = boxes[~is_square]
    assert 30 < len(beams) < 80 and np.all((beams[:, 2] >= 1.0) & (beams[:, 2] <= 5.0))
    along = 0.5 * beams[:, 3:4] * np.column_stack([np.cos(beams[:, 6]), np.sin(beams[:, 6])])
    feet = np.vstack([world.cylinders[:, :2], boxes[is_square, :2]])
    for end in (beams[:, :2] - along, beams[:, :2] + along):
        assert np.linalg.norm(end[:, None] - feet, axis=2).min(axis=1).max() < 1e-9, "a beam ends in a pillar"
