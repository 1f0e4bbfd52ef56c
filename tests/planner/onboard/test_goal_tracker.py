import logging

import numpy as np
import pytest

from aero_planner.onboard.goal_tracker import GoalTracker
from aero_planner.onboard.settings import LimitSettings


def test_a_refused_goal_is_looked_at_again_when_it_is_sent_again(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LimitSettings(fence_height_min=1.0, fence_height_max=10.0), (0.0, 0.0, 4.0))
    caplog.set_level(logging.INFO)
    received = np.array([5.0, 0.0, 11.0])
    goals.update(received)
    np.testing.assert_array_equal(goals.goal, [0.0, 0.0, 4.0])
    goals.update(received, ground=2.0)
    assert goals.count == 0  # nobody sent it again
    goals.update(received.copy())
    assert goals.count == 0 and caplog.text.count("is refused") == 1
    goals.update(received.copy(), ground=2.0)
    np.testing.assert_array_equal(goals.goal, received)
    assert goals.count == 1


def test_an_accepted_goal_counts_once_however_often_it_is_sent():
    goals = GoalTracker(LimitSettings(), None)
    for _ in range(3):
        goals.update(np.array([5.0, 0.0, 3.0]))
    assert goals.count == 1
    goals.update(np.array([6.0, 0.0, 3.0]))
    assert goals.count == 2


def test_a_goal_that_is_not_finite_is_refused():
    goals = GoalTracker(LimitSettings(), None)
    goals.update(np.array([np.nan, 0.0, 3.0]))
    assert goals.goal is None and goals.count == 0
    with pytest.raises(ValueError, match="must be three finite numbers"):
        GoalTracker(LimitSettings(), (np.inf, 0.0, 3.0))


@pytest.mark.parametrize("is_sent", [False, True])
def test_a_goal_is_refused_when_the_ground_turns_out_to_be_above_it(caplog: pytest.LogCaptureFixture, is_sent: bool):
    place = np.array([20.0, 0.0, 2.0])
    goals = GoalTracker(LimitSettings(), None if is_sent else place)
    sent = place if is_sent else None
    goals.update(sent)
    np.testing.assert_array_equal(goals.goal, place)
    goals.update(sent, ground=6.0)
    assert goals.goal is None
    assert "at -4.00 instead of 1 to 30 m above the ground, which is at a height of 6.00 m" in caplog.text
    assert "send another goal, or correct --goal or limits.fence_*" in caplog.text
    goals.update(np.array([20.0, 0.0, 8.0]), ground=6.0)
    assert goals.goal is not None


def test_a_goal_over_known_ground_stays_until_the_ground_is_found_again(caplog: pytest.LogCaptureFixture):
    goals, sent = GoalTracker(LimitSettings(), None), np.array([20.0, 0.0, 1.1])
    for ground in (0.0, 3.0, 0.0):  # over a roof
        goals.update(sent, ground=ground)
        np.testing.assert_array_equal(goals.goal, sent)
    goals.update(sent, ground=None)  # the origin has moved
    goals.update(sent, ground=0.5)
    assert goals.goal is None and caplog.text.count("is refused") == 1
    goals.update(sent.copy(), ground=-0.5)
    np.testing.assert_array_equal(goals.goal, sent)
    assert goals.count == 2


def test_a_first_goal_below_the_origin_waits_for_the_height_of_the_ground(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LimitSettings(), (20.0, 0.0, -4.0))
    assert goals.goal is None and "waits until the height of the ground is known" in caplog.text
    goals.update(None)
    assert goals.goal is None
    goals.update(None, ground=-10.0)
    np.testing.assert_array_equal(goals.goal, [20.0, 0.0, -4.0])


def test_a_goal_that_is_not_reached_is_reported_once(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LimitSettings(arrival_radius=1.0), (20.0, 0.0, 4.0))
    for k in range(600):
        time, x = 1000.0 + 0.1 * k, min(0.5 * k, 17.7)
        goals.advance(time, (x, 0.0, 4.0), 0.1, flying=k >= 100)
        assert ("come nearer" in caplog.text) == (k >= 200)
    assert caplog.text.count("has not come nearer than 2.3 m to the goal within 10 s: the goal may lie in") == 1
    goals.update(np.array([5.0, 0.0, 3.0]))
    for k in range(200):
        goals.advance(1060.0 + 0.1 * k, (5.0, 0.5, 3.0), 0.1, flying=True)
    assert caplog.text.count("come nearer") == 1, "a drone at its goal has reached it"
