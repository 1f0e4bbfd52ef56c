import numpy as np
import pytest

from aero_viz.scenes import World, forest, inclines, verticals
from aero_viz.scenes.clearance_grid import ClearanceGrid
from aero_viz.scenes.passable import is_passable

START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([10.0, 0.0, 2.0])
REGION = [[-1.0, -4.0], [11.0, 4.0]]


def walled(gap: float, *, centre: float = 0.6) -> World:
    """A wall across the region at x = 5, with a gap around y = `centre`."""
    left, right = centre - 0.5 * gap, centre + 0.5 * gap
    sides = [(-9.0, left), (right, 9.0)] if gap > 0.0 else [(-9.0, 9.0)]
    boxes = [[5.0, 0.5 * (a + b), 2.0, 0.3, b - a, 12.0, 0.0] for a, b in sides]
    return World("walled", START, GOAL, boxes=np.array(boxes))


@pytest.mark.parametrize("radius", [0.2, 0.25, 0.4])
@pytest.mark.parametrize("centre", [0.0, 0.63])
def test_wall_with_a_gap_of_known_width(radius, centre):
    # Undecided cases lie within 0.9 cell above the radius; narrower gaps are never passable.
    assert is_passable(walled(2.0 * radius + 0.2, centre=centre), radius=radius, region=REGION)
    assert not is_passable(walled(2.0 * radius - 0.002, centre=centre), radius=radius, region=REGION)


def test_closed_wall():
    assert not is_passable(walled(0.0), radius=0.02, region=REGION)


def test_gap_above_the_band_counts_only_where_the_band_allows():
    low = World("low", START, GOAL, boxes=np.array([[5.0, 0.0, 2.0, 0.3, 30.0, 4.0, 0.0]]))
    assert not is_passable(low, region=REGION)  # its top is at 4 m, the band ends at 3.5 m
    assert is_passable(low, region=REGION, band=(0.5, 5.0))
    assert not is_passable(low, region=REGION, band=(0.5, 4.2))


@pytest.mark.parametrize("half", [0.3, 0.55, 0.9])
def test_the_answer_changes_within_a_cell_of_half_the_gap(half):
    world = walled(2.0 * half)
    assert is_passable(world, radius=half - 0.09, region=REGION)
    assert not is_passable(world, radius=half + 1e-3, region=REGION)


def test_the_clearance_of_the_start_limits_the_radius():
    world = World("free", START, GOAL, spheres=np.array([[0.0, 2.0, 2.0, 1.0], [5.0, 3.5, 2.0, 0.1]]))
    assert is_passable(world, radius=0.91) and not is_passable(world, radius=1.001)


def test_start_or_goal_inside_an_obstacle():
    world = World("inside", START, GOAL, spheres=np.array([[10.1, 0.0, 2.0, 0.3]]))
    assert not is_passable(world) and not is_passable(world, radius=0.001)


def test_empty_world_is_passable():
    assert is_passable(World("empty", START, GOAL), radius=1.0)


def test_distances_of_the_grid_are_exact_up_to_the_maximum():
    rng = np.random.default_rng(0)
    axis = rng.normal(size=(20, 3))
    world = World(
        "mixed",
        START,
        GOAL,
        cylinders=np.column_stack(
            [
                rng.uniform([0, -4, 0], [10, 4, 3], (20, 3)),
                axis / np.linalg.norm(axis, axis=1, keepdims=True),
                rng.uniform(0.1, 0.4, 20),
                rng.uniform(0.5, 4.0, 20),
            ]
        ),
        boxes=np.array([[5.0, 2.0, 1.0, 1.0, 2.0, 3.0, 0.7], [5.0, 0.0, -0.5, 60.0, 60.0, 1.0, 0.0]]),
        spheres=np.array([[2.0, -2.0, 2.0, 0.5]]),
    )
    grid = ClearanceGrid.measure(world, cell=0.3, distance_max=0.8)
    places = grid.corner + 0.3 * np.moveaxis(np.indices(grid.distance.shape), 0, -1)
    expected = np.minimum(world.distance(places), 0.8).reshape(grid.distance.shape)
    np.testing.assert_allclose(grid.distance, expected, atol=1e-5)
    np.testing.assert_allclose(places[grid.index(world.start)], world.start, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_thousand_cylinders_leave_no_path_if_widths_are_radii(seed):
    # The paper's text; read as widths, as in its figure, a drone of radius 0.25 m gets through.
    assert not is_passable(verticals(seed=seed, width=(0.8, 2.2)), radius=0.02)
    assert is_passable(verticals(seed=seed), radius=0.25)


def test_default_scenes_are_passable():
    assert is_passable(forest(seed=0)) and is_passable(inclines(seed=0), radius=0.4)


def test_invalid_arguments_are_refused():
    with pytest.raises(ValueError, match="positive"):
        is_passable(walled(1.0), radius=0.0)
    with pytest.raises(ValueError, match="too large"):
        is_passable(walled(0.52), radius=0.25, cell=0.002, region=REGION)
