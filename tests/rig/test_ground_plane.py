"""The ground in the cloud of a simulated Mid-360, which looks only 7 degrees down."""

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner.onboard.ground_plane import find_ground
from aero_viz.scenes import World
from tests.rig.hover import scan

GROUND = [0.0, 0.0, -1.0, 120.0, 120.0, 2.0, 0.0]  # its top is at 0
TRUNKS = [[x, y, 0.0, 0, 0, 1, 0.3, 8.0] for x, y in ((4, 3), (-5, 2), (3, -6), (-2, -4), (8, 1), (-9, -7), (1, 9))]


def world(cylinders: list[list[float]], boxes: list[list[float]]) -> World:
    parts = np.array(cylinders).reshape(-1, 8), np.array(boxes).reshape(-1, 7)
    return World("ground", np.array([0.0, 0, 2]), np.array([5.0, 0, 2]), *parts)


def cloud(world: World, height: float, error: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float32]:
    """Return ten sweeps of a level drone above the origin, whose estimated roll and pitch are wrong [deg]."""
    return np.concatenate(scan(world, np.array([0.0, 0.0, height]), [(0.0, 0.0, *error)] * 10))


@pytest.mark.parametrize("height", [1.0, 2.0, 3.0])
def test_the_ground_between_trunks_is_found(height: float):
    found = find_ground(cloud(world(TRUNKS, [GROUND]), height), np.array([0.0, 0.0, height]))
    assert found == pytest.approx(0.0, abs=0.03)


def test_a_wrong_attitude_hardly_matters():
    found = find_ground(cloud(world(TRUNKS, [GROUND]), 2.0, (3.0, -2.0)), np.array([0.0, 0.0, 2.0]))
    assert found == pytest.approx(0.0, abs=0.15)


def test_trunks_alone_are_no_ground():
    """Their lowest visible points lie on a cone below the drone."""
    trunks = [[r * np.cos(a), r * np.sin(a), -5.0, 0, 0, 1, 0.3, 15.0] for a in np.linspace(0, 6, 24) for r in (4, 7)]
    assert find_ground(cloud(world(trunks, []), 2.0), np.array([0.0, 0.0, 2.0])) is None


def test_ground_on_one_side_is_not_enough():
    """The drone hovers beside a terrace."""
    terrace = [30.0, 0.0, 0.0, 40.0, 120.0, 2.0, 0.0]
    assert find_ground(cloud(world([], [terrace]), 2.0), np.array([0.0, 0.0, 2.0])) is None


def test_no_points_are_no_ground():
    assert find_ground(np.zeros((0, 3), np.float32), np.zeros(3)) is None
