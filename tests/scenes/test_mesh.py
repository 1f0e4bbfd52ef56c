"""Solids that are cut at a height, for whoever looks from above."""

import numpy as np
import pytest

from aero_viz.scenes import World, world_instances
from aero_viz.scenes.mesh import Instances

LEAN = np.array([0.6, 0.0, 0.8])
WORLD = World(
    "solids",
    np.zeros(3),
    np.ones(3),
    cylinders=np.array(
        [
            [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.3, 8.0],  # stands from 0 to 8 m
            [5.0, 0.0, 6.0, 0.0, 0.0, -1.0, 0.3, 6.0],  # hangs from 6 to 0 m
            [9.0, 0.0, 0.0, *LEAN, 0.3, 5.0],  # leans, up to 4 m
            [0.0, 9.0, 5.0, 1.0, 0.0, 0.0, 0.1, 4.0],  # a wire at 5 m
            [0.0, 9.0, 1.0, 1.0, 0.0, 0.0, 0.1, 4.0],  # a wire at 1 m
        ]
    ),
    boxes=np.array([[0.0, 0.0, 6.0, 20.0, 20.0, 0.2, 0.0], [3.0, 3.0, 2.0, 1.0, 1.0, 4.0, 0.4]]),
    spheres=np.array([[0.0, 5.0, 7.0, 2.0], [0.0, 5.0, 1.0, 2.0]]),
)


def highest(solid: Instances) -> np.ndarray:
    """Return the height of the top of each copy [m]; -inf for one that is too small to be seen."""
    vertices = solid.merged().vertices.reshape(len(solid.positions), -1, 3)
    return np.where(np.ptp(vertices, axis=1).max(axis=1) < 1e-3, -np.inf, vertices[..., 2].max(axis=1))


@pytest.mark.parametrize("height", [2.5, 3.0, 100.0])
def test_nothing_that_stands_reaches_over_the_cut(height):
    whole = world_instances(WORLD)
    cut = {kind: solid.below(height) for kind, solid in whole.items()}
    top = highest(cut["cylinders"])
    assert (top[:2] <= min(height, 8.0) + 1e-6).all() and top[2] <= min(height, 4.0) + 0.3
    assert np.isneginf(top[3]) == (height < 5.0) and np.isfinite(top[4])
    boxes = highest(cut["boxes"])
    assert np.isneginf(boxes[0]) == (height < 5.9) and boxes[1] == pytest.approx(min(height, 4.0))
    assert np.isneginf(highest(cut["spheres"])[0]) == (height < 7.0) and np.isfinite(highest(cut["spheres"])[1])
    if height > 50.0:
        for kind, solid in whole.items():
            np.testing.assert_allclose(cut[kind].merged().vertices, solid.merged().vertices, atol=1e-5)


def test_what_is_below_the_cut_stays_where_it_was():
    before, after = (solid.merged().vertices for solid in (world_instances(WORLD)["cylinders"], cut_cylinders(2.0)))
    shape = (len(WORLD.cylinders), -1, 3)
    for row in (0, 1, 2):
        low = [vertices.reshape(shape)[row][:, 2].min() for vertices in (before, after)]
        assert low[0] == pytest.approx(low[1], abs=1e-5)
        sides = [np.ptp(vertices.reshape(shape)[row][:, 1]) for vertices in (before, after)]
        assert sides[0] == pytest.approx(sides[1], abs=1e-5), "as thick as before"
    rotations = cut_cylinders(-5.0).rotations
    assert np.isfinite(rotations).all(), "also of what is gone"


def cut_cylinders(height: float) -> Instances:
    return world_instances(WORLD)["cylinders"].below(height)
