import logging

import numpy as np
import pytest

from aero_planner.onboard.goal_tracker import GoalTracker
from aero_planner.onboard.settings import LimitSettings


def test_a_refused_goal_is_looked_at_again_when_it_is_sent_again(caplog: pytest.LogCaptureFixture):
    goals = GoalTracker(LimitSettings(fence_height_min=1.0, fence_height_max=10.0), (0.0, 0.0, 2.0))
    caplog.set_level(logging.INFO)
    received = np.array([5.0, 0.0, 11.0])
    goals.update(received)
    np.testing.assert_array_equal(goals.goal, [0.0, 0.0, 2.0])
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
