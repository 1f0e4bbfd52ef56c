"""Moving the goal with the mouse."""

from __future__ import annotations

import numpy as np
import pytest

from tests.browser.desk import Desk, open_desk


@pytest.fixture
def near(browser):
    """A goal that was typed in, 6 m ahead of the drone, with its arrows."""
    with open_desk(browser, ticks=10, size=(1280, 720)) as desk:
        ahead = desk.control("Goal").locator("input").first
        ahead.fill("6")
        ahead.press("Enter")
        desk.wait_for(lambda: goal_of(desk)[0] == 6.0, "the goal that was typed in")
        desk.checkbox("Drag the goal").click()
        desk.dashboard.show_only(["goal", "drone"])
        desk.wait_for(lambda: arrow_tip(desk) > 0, "the arrows")
        yield desk
        assert desk.console == []


def goal_of(desk: Desk) -> np.ndarray:
    return np.asarray(desk.session.frame.observation.goal.position)  # type: ignore[union-attr]


def arrow_tip(desk: Desk) -> int:
    """Topmost row of the window with the blue of the arrow that points upward, 0 where there is none."""
    image = desk.screenshot().astype(int)
    blue = (image[..., 2] > 200) & (image[..., 0] < 90) & (image[..., 1] < 170)
    return int(blue.any(axis=1).argmax())


def test_dragging_an_arrow_moves_the_goal_along_it_and_the_plan_with_it(near):
    before, plan = goal_of(near), near.session.frame.plan
    tip = near.place_on_page(np.add(before, (0.0, 0.0, 1.8)))
    near.drag(tip, (0.0, -60.0))
    near.wait_for(lambda: goal_of(near)[2] > before[2] + 0.5, "a higher goal")
    after = goal_of(near)
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-3)
    assert not np.array_equal(near.session.frame.plan.positions, plan.positions)
    # The numbers follow, though time stands still.
    shown = near.control("Goal").locator("input").last
    near.wait_for(lambda: abs(float(shown.input_value()) - goal_of(near)[2]) < 0.06, "the number to follow")


def test_a_goal_dragged_into_the_ground_is_refused_and_the_arrows_return(near):
    before = goal_of(near)
    tip = near.place_on_page(np.add(before, (0.0, 0.0, 1.8)))
    near.drag(tip, (0.0, 300.0))
    near.refusal("below the ground").wait_for(timeout=10_000)
    after = goal_of(near)
    assert 0.0 <= after[2] < before[2], "the last free place on the way"
    near.page.mouse.move(600.0, 650.0)  # what the mouse is over is yellow
    tip = near.place_on_page(np.add(after, (0.0, 0.0, 1.8)))
    near.wait_for(lambda: abs(arrow_tip(near) - tip[1]) < 25, "the arrows to return to the goal that stays")
    index = near.session.frame.index
    near.click("+1")
    near.wait_for(lambda: near.session.frame.index == index + 1, "the flight to go on")


@pytest.mark.parametrize(("value", "words"), [("1e30", "lies outside the bounds"), ("-900", "lies outside the bounds")])
def test_a_goal_beyond_the_world_is_refused_and_the_numbers_return(near, value, words):
    before = goal_of(near)
    ahead = near.control("Goal").locator("input").first
    ahead.fill(value)
    ahead.press("Enter")
    near.refusal(words).wait_for(timeout=10_000)
    np.testing.assert_array_equal(goal_of(near), before)
    near.wait_for(lambda: float(ahead.input_value()) == 6.0, "the number to return")
