"""Two visitors with browsers of their own: one has control, the other looks on."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page

from aero_planner import PlannerConfig
from aero_viz.dashboard.links import Link, Opening
from tests.browser.desk import COARSE, TIMEOUT, Desk, open_desk, quick_forest, visit
from tests.browser.pictures import differing


@pytest.fixture(scope="module")
def desk(browser: Browser) -> Iterator[Desk]:
    """A paused flight whose first visitor has control."""
    with open_desk(browser, quick_forest(), ticks=10, layers=["drone"], size=(1000, 700)) as desk:
        desk.page.get_by_role("tab", name="Tune").wait_for()
        yield desk
        assert desk.console == []


@pytest.fixture
def second(desk: Desk, browser: Browser) -> Iterator[Page]:
    """Page of a second visitor."""
    page = visit(browser, desk.dashboard.url, resolution=COARSE)
    desk.wait_for(lambda: desk.dashboard.server.visitors.count == 2, "the second visitor")
    page.get_by_text("You are watching; your camera and layers are your own.").wait_for()
    yield page
    page.close()
    desk.wait_for(lambda: desk.dashboard.server.visitors.count == 1, "the second visitor to leave")


def checkbox(page: Page, label: str):
    row = page.locator("label", has_text=re.compile(f"^{re.escape(label)}$"))
    return row.locator("xpath=ancestor::div[contains(@class, 'Flex')][1]").get_by_role("checkbox")


def test_a_visitor_who_looks_on_cannot_step_until_taking_control(desk: Desk, second: Page):
    desk.page.get_by_text("2 visitors").wait_for()
    assert desk.page.get_by_role("button", name="Take control").count() == 0
    before = desk.session.frame
    assert before is not None
    second.get_by_role("button", name="+10").click()
    second.locator(".mantine-Notification-root", has_text="You are watching").wait_for()
    second.get_by_role("tab", name="Tune").click()
    slider = second.get_by_role("slider").last
    shown = slider.get_attribute("aria-valuenow")
    slider.focus()
    second.keyboard.press("ArrowRight")
    desk.wait_for(lambda: slider.get_attribute("aria-valuenow") == shown, "the old value of the slider")
    assert desk.session.frame is before and desk.session.config is before.config
    second.get_by_role("button", name="Take control").click()
    desk.page.get_by_role("button", name="Take control").wait_for()
    second.get_by_text("You control the session.").wait_for()
    second.get_by_role("button", name="+10").click()
    desk.wait_for(lambda: desk.session.frame is not before, "a step")
    desk.page.get_by_role("button", name="Take control").click()
    second.get_by_role("button", name="Take control").wait_for()


def test_a_link_is_opened_by_a_visitor_who_takes_control_with_the_answer(desk: Desk, browser: Browser):
    link = Link.to_moment(Opening("forest", seed=0), 0.04, PlannerConfig()).query
    page = browser.new_page()
    page.goto(f"{desk.dashboard.url}/{link}")
    page.get_by_text("Open this link?").wait_for(timeout=1e3 * TIMEOUT)
    page.get_by_role("button", name="Take control, open", exact=True).click()
    desk.page.get_by_role("button", name="Take control", exact=True).wait_for()
    desk.wait_for(lambda: desk.session.frame is not None and abs(desk.session.frame.time - 0.04) < 0.01, "the moment")
    page.close()
    desk.wait_for(lambda: desk.dashboard.server.visitors.count == 1, "the second visitor to leave")


def test_the_line_about_the_visitors_leaves_room_for_the_controls(desk: Desk, second: Page):
    """Only what is below the tabs scrolls, so that no second scroll bar covers the controls."""
    hidden = "() => { const e = document.querySelector('.mantine-ScrollArea-viewport');"
    hidden += " return e.scrollHeight - e.clientHeight; }"
    for page in (desk.page, second):
        page.get_by_role("tab", name="Tune").click()
        desk.wait_for(lambda page=page: page.evaluate(hidden) <= 0, "the panel to fit")


def test_a_search_belongs_to_its_visitor_and_needs_no_control(desk: Desk, second: Page):
    for page in (desk.page, second):
        page.get_by_role("tab", name="Tune").click()
        page.get_by_text("Goal position weight").first.wait_for()
    search = second.locator("label", has_text="Search").locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")
    search.locator("input").fill("decay rate")
    second.get_by_text("Goal position weight").first.wait_for(state="detached")
    second.get_by_text("Decay").first.wait_for()
    assert desk.control("Search").locator("input").input_value() == ""
    assert desk.page.get_by_text("Goal position weight").first.is_visible()
    assert desk.page.get_by_text("Decay").count() == 0
    search.locator("input").fill("")
    second.get_by_text("Goal position weight").first.wait_for()


def test_layers_and_camera_belong_to_each_visitor(desk: Desk, second: Page):
    cells = desk.dashboard.layers["coarse_cells"]
    assert not cells.visible
    empty = desk.settled_screenshot()
    second.get_by_role("tab", name="Layers").click()
    checkbox(second, cells.title).check()
    desk.wait_for(lambda: cells.visible, "the layer")
    desk.open_tab("Layers")
    assert desk.checkbox(cells.title).is_checked() is False
    second.get_by_role("button", name="top", exact=True).click()
    numbers = list(desk.dashboard.server.get_clients())
    heights = lambda: [desk.dashboard.server.get_clients()[n].camera.position[2] for n in numbers]  # noqa: E731
    desk.wait_for(lambda: heights()[1] > 2.0 * heights()[0], "the view from above")
    assert differing(desk.settled_screenshot(), empty) == 0, "the first visitor sees the second one's choice"
    checkbox(second, cells.title).uncheck()
    desk.wait_for(lambda: not cells.visible, "nobody to see the layer")
