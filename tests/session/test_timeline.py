import numpy as np
import pytest

from aero_planner.history import History
from aero_viz.session.timeline import Checkpoint, Timeline

HISTORY = History({"tick": np.zeros(1, np.int32)})


def flown(count: int, **options: int) -> Timeline:
    timeline = Timeline(**options)
    for i in range(count):
        timeline.append(Checkpoint(0.1 * i, i, HISTORY), (float(i), 0.0, 0.0))
    return timeline


def test_an_empty_timeline_is_false():
    assert not Timeline()
    assert Timeline().time_range == (0.0, 0.0)


@pytest.mark.parametrize(("time", "index"), [(-1.0, 0), (0.0, 0), (0.25, 2), (0.3, 3), (99.0, 9)])
def test_going_to_a_time_finds_the_tick_at_or_before_it(time: float, index: int):
    timeline = flown(10)
    assert timeline.go_to_time(time).source == index
    assert timeline.index == index
    np.testing.assert_array_equal(timeline.trail()[:, 0], np.arange(index + 1))


def test_continuing_from_an_earlier_tick_discards_later_ones_but_changes_no_published_trail():
    timeline = flown(10)
    before = timeline.trail()
    timeline.go_by(-5)
    timeline.append(Checkpoint(0.5, "other", HISTORY), (50.0, 0.0, 0.0))
    np.testing.assert_array_equal(before[:, 0], np.arange(10))
    np.testing.assert_array_equal(timeline.trail()[:, 0], [0, 1, 2, 3, 4, 50])
    assert timeline.time_range == (0.0, 0.5)


def test_trails_are_read_only_and_survive_growth():
    timeline = flown(3000)
    trail = timeline.trail()
    with pytest.raises(ValueError, match="read-only"):
        trail[0] = 1.0
    np.testing.assert_array_equal(trail[:, 0], np.arange(3000))


def test_the_oldest_ticks_are_discarded_beyond_the_capacity():
    timeline = flown(25, capacity=10)
    assert timeline.index == 24
    assert timeline.time_range == (pytest.approx(1.5), pytest.approx(2.4))
    np.testing.assert_array_equal(timeline.trail()[:, 0], np.arange(25))
