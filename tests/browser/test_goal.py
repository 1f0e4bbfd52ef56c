"""Moving the goal with the mouse."""

import numpy as np
import pytest
from playwright.sync_api import Locator

from aero_viz.dashboard.panels.base import ARROWS, Hold
from tests.browser.desk import Desk, open_desk, quick_forest

ARROW = ARROWS["scale"]


@pytest.fixture(scope="module")
def desk(browser):
    """A page with the arrows that move the goal, shared by the tests of this module."""
    with open_desk(
        browser, quick_forest(), ticks=10, size=(1280, 720), resolution=0.5, layers=["goal", "drone"]
    ) as desk:
        desk.checkbox("Drag the goal").click()
        yield desk
        assert desk.console == []


@pytest.fixture
def near(desk):
    """A goal that was typed in, at x = 6 m, with its arrows."""
    desk.session.set_goal((10.0, 0.0, 2.0)).result()
    desk.wait_for(lambda: [box.input_value() for box in coordinates(desk)] == ["10", "0", "2"], "the goal in numbers")
    x = coordinates(desk)[0]
    desk.enter(x, "6")
    desk.wait_for(lambda: goal_of(desk).tolist() == [6.0, 0.0, 2.0], "the goal that was typed in")
    desk.page.mouse.move(600.0, 650.0)  # an arrow under the mouse would be yellow
    desk.page.wait_for_timeout(1200 * Hold.SECONDS)  # after a drag, the arrows stay where they were dropped
    desk.settled_screenshot()
    desk.wait_for(lambda: abs(arrow_tip(desk) - tip(desk)[1]) < 25, "the arrows")
    return desk


def coordinates(desk: Desk) -> list[Locator]:
    """The number fields of the goal: x, y and z."""
    return desk.control("Goal [m]").locator("input").all()


def goal_of(desk: Desk) -> np.ndarray:
    return np.asarray(desk.session.frame.observation.goal.position)  # type: ignore[union-attr]


def arrow_tip(desk: Desk) -> int:
    """Topmost row of the page with the blue of the arrow that points upward, 0 if there is none."""
    image = desk.screenshot().astype(int)
    blue = (image[..., 2] > 200) & (image[..., 0] < 90) & (image[..., 1] < 170)
    return int(blue.any(axis=1).argmax())


def tip(desk: Desk) -> tuple[float, float]:
    """Place on the page near the tip of the arrow that points upward, whatever the distance of the goal."""
    x, y = desk.place_on_page(goal_of(desk))
    return x, y - 0.85 * ARROW


@pytest.mark.parametrize("distance", [6.0, 40.0])
@pytest.mark.parametrize("beside", [-11.0, 11.0])
def test_the_handle_of_a_goal_is_24_pixels_wide_at_any_distance(near, distance, beside):
    x = coordinates(near)[0]
    near.enter(x, f"{distance:g}")
    near.wait_for(lambda: goal_of(near)[0] == distance, "the goal")
    near.page.wait_for_timeout(1200 * Hold.SECONDS)
    near.wait_for(lambda: abs(arrow_tip(near) - tip(near)[1]) < 25, "the arrows")
    before, (column, row) = goal_of(near), tip(near)
    near.drag((column + beside, row + 0.1 * ARROW), (0.0, -16.0))
    near.wait_for(lambda: goal_of(near)[2] > before[2] + 0.1, "a higher goal")
    near.settled(lambda: goal_of(near), "the end of the drag")
    np.testing.assert_allclose(goal_of(near)[:2], before[:2], atol=1e-3)


def test_dragging_an_arrow_moves_the_goal_along_it_and_changes_the_plan(near):
    before, plan = goal_of(near), near.session.frame.plan
    near.drag(tip(near), (0.0, -60.0))
    near.wait_for(lambda: goal_of(near)[2] > before[2] + 0.5, "a higher goal")
    after = goal_of(near)
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-3)
    assert not np.array_equal(near.session.frame.plan.positions, plan.positions)
    # The numbers follow although time stands still.
    shown = near.control("Goal [m]").locator("input").last
    near.wait_for(lambda: abs(float(shown.input_value()) - goal_of(near)[2]) < 0.06, "the number to follow")


def test_a_goal_dragged_into_the_ground_is_accepted_and_the_page_says_that_it_cannot_be_reached(near):
    near.drag(tip(near), (0.0, 300.0))
    near.page.get_by_text("so the drone flies as near to it as is safe").first.wait_for()
    assert goal_of(near)[2] < 0.0
    index = near.session.frame.index
    near.click("+1")
    near.wait_for(lambda: near.session.frame.index == index + 1, "the next tick")


def test_a_goal_too_far_away_for_a_number_is_refused_and_the_numbers_return(near):
    before = goal_of(near)
    x = coordinates(near)[0]
    near.enter(x, "1e9")  # from 1e15 on, the field itself refuses a number
    refusal = near.refusal("goal stays where it was")
    refusal.wait_for()
    near.dismiss(refusal)
    np.testing.assert_array_equal(goal_of(near), before)
    near.wait_for(lambda: float(x.input_value()) == 6.0, "the number to return")
