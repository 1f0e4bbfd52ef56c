import math

import pytest

from aero_planner.onboard.ground_tracker import GroundSource, GroundTracker


@pytest.fixture
def ground() -> GroundTracker:
    return GroundTracker()


def add_ranges(ground: GroundTracker, start: float, *heights: float) -> None:
    for k, height in enumerate(heights):
        ground.add_range(start + 0.1 * k, height)


def test_the_best_source_wins(ground: GroundTracker):
    assert (ground.height, ground.source) == (0.0, GroundSource.ASSUMED)
    ground.add_standing(0.48)
    assert (ground.height, ground.source) == (0.48, GroundSource.STANDING)
    ground.add_cloud(1.0, 0.6)
    assert ground.source is GroundSource.STANDING  # one measurement is not enough
    ground.add_cloud(2.0, 0.6)
    assert (ground.height, ground.source) == (0.6, GroundSource.CLOUD)
    add_ranges(ground, 2.1, *[0.7] * 5)
    assert (ground.height, ground.source) == (0.7, GroundSource.RANGE)
    for k in range(3):
        ground.add_cloud(3.0 + k, 0.6)
    assert ground.source is GroundSource.RANGE  # it has measured a moment ago
    for k in range(3):
        ground.add_cloud(20.0 + k, 0.65)
    assert (ground.height, ground.source) == (0.65, GroundSource.CLOUD)


def test_a_measured_height_stays_in_force(ground: GroundTracker):
    add_ranges(ground, 0.0, *[0.7] * 5)
    add_ranges(ground, 100.0, 3.0)
    assert ground.height == 0.7
    ground.add_range(100.2, math.nan)
    assert ground.height == 0.7


def test_a_bush_below_the_drone_is_not_the_ground(ground: GroundTracker):
    add_ranges(ground, 0.0, *[0.1] * 20, *[1.1] * 10, *[0.1] * 5)
    assert ground.height == pytest.approx(0.1)


def test_a_slope_is_followed(ground: GroundTracker):
    add_ranges(ground, 0.0, *(0.01 * k for k in range(200)))
    assert 1.5 < ground.height < 1.99


def test_a_moved_origin_makes_it_forget(ground: GroundTracker):
    add_ranges(ground, 0.0, *[0.7] * 5)
    ground.clear()
    assert (ground.height, ground.source) == (0.0, GroundSource.ASSUMED)
