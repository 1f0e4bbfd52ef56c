"""The page for fingers, for large text, by the keyboard alone, and for screen readers."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from tests.browser.desk import COARSE, TIMEOUT, Desk, visit, with_resolution

TABS = ("Fly", "World", "Why", "Layers", "Tune")
ROLES = {
    "button", "checkbox", "slider", "textbox", "combobox", "spinbutton", "tab", "link", "switch", "menuitem", "option",
    "searchbox", "radio",
}  # fmt: skip
SMALL = """
() => {
  const controls = "button, input, textarea, [role=tab], [role=slider], a[href]";
  const seen = [...document.querySelectorAll(controls)].filter(e => e.checkVisibility() && e.offsetWidth > 0);
  const small = [];
  for (const e of seen) {
    e.scrollIntoView({block: "center"});
    const box = e.getBoundingClientRect(), x = box.x + box.width / 2, y = box.y + box.height / 2;
    const offsets = [[0, -19], [0, 19], ...(e.matches("[role=slider]") ? [] : [[-19, 0], [19, 0]])];
    for (const [dx, dy] of offsets) {
      const found = document.elementFromPoint(x + dx, y + dy);
      if (found && (e.contains(found) || found.contains(e) && found.closest(".mantine-Slider-root"))) continue;
      small.push(`${e.tagName} ${e.ariaLabel ?? e.innerText}: ${found?.outerHTML.slice(0, 200)} at ${dx}, ${dy}`);
    }
  }
  return small;
}
"""
"""Script that returns the controls that a finger misses 19 px beside their middle."""


FOCUSED = "document.activeElement.matches('input') && document.activeElement.id"
"""Script that returns whether a field has the focus."""


def nodes(page: Page) -> list[tuple[str, str, Any]]:
    """Return role, name and id of every control in the accessibility tree."""
    tree = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    found = [node for node in tree if not node.get("ignored")]
    return [
        (node["role"]["value"], node.get("name", {}).get("value", "").strip(), node.get("backendDOMNodeId"))
        for node in found
        if node.get("role", {}).get("value") in ROLES
    ]


def test_a_screen_reader_finds_a_name_on_every_control(fresh_desk: Desk):
    page = fresh_desk.page
    page.get_by_text("shorter is better").wait_for()
    for tab in TABS:
        fresh_desk.open_tab(tab)
        fresh_desk.wait_for(lambda: len(nodes(page)) > 15, f"the controls of {tab}")
        fresh_desk.wait_for(lambda: not [role for role, name, _ in nodes(page) if not name], f"names in {tab}")
    names = {name for _, name, _ in nodes(page)}
    assert {"Play", "Time [s]", "Search", "Search commands", "Settings of the page"} <= names
    fresh_desk.open_tab("Fly")
    for axis in ("Goal [m] y", "Goal [m] z"):
        page.get_by_role("textbox", name=axis, exact=True).wait_for()
    page.keyboard.press("Control+k")
    page.get_by_placeholder("Search commands...").wait_for()
    fresh_desk.wait_for(lambda: not [role for role, name, _ in nodes(page) if not name], "names in the palette")
    assert fresh_desk.console == []


@pytest.fixture
def phone(browser: Browser, restored_desk: Desk):
    """The page on a phone, which has taken control."""
    size = {"width": 390, "height": 844}
    context = browser.new_context(viewport=size, has_touch=True, is_mobile=True, device_scale_factor=2)  # type: ignore[arg-type]
    context.set_default_timeout(1e3 * TIMEOUT)
    page = context.new_page()
    page.goto(with_resolution(restored_desk.dashboard.url, COARSE))
    page.get_by_role("button", name="Take control").tap()
    page.get_by_text("You are watching").wait_for(state="hidden")
    yield page
    context.close()


def test_a_finger_hits_every_control_of_a_phone(phone: Page):
    for close in phone.locator(".mantine-Notification-closeButton").all():
        close.tap()
    for tab in TABS:
        phone.get_by_role("tab", name=tab).tap()
        phone.wait_for_timeout(500)
        assert phone.evaluate(SMALL) == [], tab
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390, tab


def test_a_finger_plays_and_changes_a_layer(phone: Page, restored_desk: Desk):
    phone.get_by_role("button", name="+1", exact=True).tap()
    session = restored_desk.session
    restored_desk.wait_for(lambda: session.frame is not None and session.frame.index == 10, "one tick")
    phone.get_by_role("tab", name="Layers").tap()
    number = max(restored_desk.dashboard.server.get_clients())
    layer = restored_desk.dashboard.layers["trail"]
    before = layer.is_visible_to(number)
    switch = phone.get_by_role("checkbox", name="Flown trail")
    switch.scroll_into_view_if_needed()
    box = switch.bounding_box()
    assert box is not None
    phone.touchscreen.tap(box["x"] + 2, box["y"] + 2)
    restored_desk.wait_for(lambda: layer.is_visible_to(number) != before, "the other state")


def test_at_200_percent_every_control_of_a_tab_can_be_reached(restored_desk: Desk, browser: Browser):
    with contextlib.closing(visit(browser, restored_desk.dashboard.url, size=(640, 360), resolution=COARSE)) as page:
        _reach_everything(page)


def _reach_everything(page: Page) -> None:
    for tab, control in (("Fly", "Open path"), ("World", "Save world"), ("Tune", "Compare: pin as A")):
        page.get_by_role("tab", name=tab).click()
        button = page.get_by_role("button", name=control).first
        button.scroll_into_view_if_needed()
        box = button.bounding_box()
        assert box is not None
        hit = "([x, y]) => document.elementFromPoint(x, y).closest('button')?.innerText.trim()"
        assert page.evaluate(hit, [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]).startswith(control)
        assert box["x"] >= 0 and box["x"] + box["width"] <= 640
    assert page.evaluate("document.documentElement.scrollWidth") <= 640


def run(page: Page, words: str, command: str) -> None:
    """Choose a command of the palette with keys only."""
    page.keyboard.press("Control+k")
    page.get_by_placeholder("Search commands...").wait_for()
    page.keyboard.type(words)
    first = page.locator(".mantine-Spotlight-action").first
    first.filter(has_text=re.compile(re.escape(command))).wait_for()
    page.keyboard.press("Enter")
    page.get_by_placeholder("Search commands...").wait_for(state="hidden")


def test_the_keyboard_alone_finds_tabs_layers_and_parameters_and_changes_a_value(fresh_desk: Desk):
    desk, page = fresh_desk, fresh_desk.page
    page.get_by_role("button", name="Search commands").wait_for()
    run(page, "tab world", "Tab: World")
    page.get_by_role("button", name="Throw an obstacle").wait_for()
    desk.wait_for(lambda: page.evaluate("document.activeElement.innerText.trim()") == "World", "the focus on the tab")

    layer = desk.dashboard.layers["trail"]
    number = min(desk.dashboard.server.get_clients())
    assert not layer.is_visible_to(number)
    run(page, "layer: flown", "Layer: Flown trail")
    desk.wait_for(lambda: layer.is_visible_to(number), "the trail")

    # One that is not among the basic ones.
    path = "costs.q_track"
    expert = next(info for info in desk.session.config.parameters() if info.live and not info.basic)
    for info in (desk.session.config.find(path), expert):
        run(page, f"parameter: {info.title}", info.title)
        desk.wait_for(lambda: page.evaluate(FOCUSED), f"the focus on {info.path}")
        label = "document.querySelector(`label[for='${document.activeElement.id}']`)?.innerText"
        assert page.evaluate(label).strip() == info.title
        page.keyboard.press("Escape")
        page.evaluate("document.activeElement.blur()")
    run(page, path, desk.session.config.find(path).title)
    desk.wait_for(lambda: page.evaluate(FOCUSED), "the focus")
    page.keyboard.press("Control+a")
    page.keyboard.type("7")
    page.keyboard.press("Enter")
    desk.wait_for(lambda: desk.session.config.get(path) == 7.0, "the new weight")
