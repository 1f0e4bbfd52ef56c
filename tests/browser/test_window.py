"""The page in a small window."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator

from aero_viz.scenes import SCENES
from tests.browser.desk import Desk


@pytest.fixture(scope="module", params=[(1280, 720), (800, 1200)], ids=["laptop", "upright"])
def small(request, quick_desk):
    """A common laptop's screen, and a screen that stands upright."""
    desk, (width, height) = quick_desk, request.param
    desk.restore()
    before = size(desk)
    desk.page.set_viewport_size({"width": width, "height": height})
    desk.wait_for(lambda: "shorter is better" in desk.page.locator("body").inner_text(), "the planner's panel")
    yield desk
    desk.page.set_viewport_size(before)


def size(desk: Desk) -> dict[str, int]:
    return desk.page.viewport_size  # type: ignore[return-value]


def test_no_panel_covers_the_drone_or_the_chosen_rollout(small):
    plan = small.session.frame.plan
    for point in (plan.positions[plan.best][0], plan.positions[plan.best][-1]):
        place = small.place_on_page(point)
        over = small.page.evaluate("([x, y]) => document.elementFromPoint(x, y)?.tagName", list(place))
        assert over == "CANVAS", f"{np.round(place)} shows {over}"


def test_the_status_takes_less_than_half_the_height(small):
    tab = small.page.get_by_role("tab", name="Planner")
    top = small.settled(lambda: tab.bounding_box()["y"], "the layout")
    assert top > 0.5 * size(small)["height"]
    small.page.get_by_role("tab", name="Legend").click()
    small.page.get_by_text("partition", exact=True).first.wait_for()
    small.page.get_by_role("tab", name="Planner").click()
    small.page.get_by_text("distance to goal").wait_for()


@pytest.mark.parametrize("tab", ["Fly", "Layers", "Tune"])
def test_no_label_is_cut_off_and_every_control_can_be_scrolled_to(small, tab):
    small.open_tab(tab)
    cut = small.page.evaluate(
        """() => [...document.querySelectorAll('label, button, input[type=text], [role=tab]')]
            .filter((e) => e.offsetParent && e.clientWidth && e.scrollWidth > e.clientWidth + 1)
            .map((e) => (e.innerText || e.value) + ' ' + e.scrollWidth + ' > ' + e.clientWidth)"""
    )
    assert cut == []
    last = small.page.locator("label:visible").last
    last.scroll_into_view_if_needed()
    box = last.bounding_box()
    assert box["y"] + box["height"] <= size(small)["height"]
    assert box["x"] + box["width"] <= size(small)["width"]
    assert small.page.evaluate("document.documentElement.scrollWidth") <= size(small)["width"]


def test_every_scene_on_offer_has_a_name_that_fits_and_a_description(small):
    small.open_tab("Fly")
    field = small.control("Scene").locator("input").first
    for name, kind in SCENES.items():
        small.choose("Scene", name)
        small.page.get_by_text(kind.description).wait_for()
        assert field.input_value() == name
        assert field.evaluate("(e) => e.scrollWidth <= e.clientWidth"), f"{name} is cut off"


def test_panels_stay_apart_while_the_window_shrinks_to_a_phone_and_grows_again(restored_desk):
    desk = restored_desk

    def box(tab: str) -> dict[str, float]:
        panel = desk.page.locator(".mantine-Paper-root", has=desk.page.get_by_role("tab", name=tab)).last
        return panel.bounding_box() or {}

    def resize(width: int) -> None:
        desk.page.set_viewport_size({"width": width, "height": 800})
        desk.settled(lambda: box("Fly").get("width", 0.0), "the layout")

    resize(600)
    assert box("Planner")["x"] + box("Planner")["width"] <= box("Fly")["x"]
    resize(480)
    assert box("Fly")["width"] == 480
    place = desk.place_on_page(desk.session.frame.observation.state.position)
    assert 0.3 < place[1] / box("Fly")["y"] < 0.7, "the drone is in the middle of what is above the controls"
    tab = desk.page.get_by_role("tab", name="Fly").bounding_box() or {}
    assert tab["height"] >= 24.0, "a finger can hit a tab"
    camera = desk.page.get_by_role("button", name="follow", exact=True).bounding_box() or {}
    assert tab["y"] + 0.5 * tab["height"] > camera["y"] + camera["height"] + 8.0, "the words of the tabs are below it"
    resize(1000)
    rows = {tab.bounding_box()["y"] for tab in desk.page.locator(".mantine-ScrollArea-content [role=tab]").all()}
    assert len(rows) == 1, "all tabs of the controls are in one row"
    desk.page.set_viewport_size({"width": 1000, "height": 600})


def test_the_thumb_of_a_slider_covers_no_number(restored_desk):
    row = restored_desk.control("Time [s]")
    thumb, number = row.get_by_role("slider"), row.locator(".mantine-Slider-markLabel").last
    thumb.press("End")
    bottom = restored_desk.settled(lambda: (thumb.bounding_box() or {})["y"], "the thumb") + thumb.evaluate(
        "e => e.offsetHeight"
    )
    ink = (number.bounding_box() or {})["y"] + 0.2 * number.evaluate("e => e.offsetHeight")
    assert ink >= bottom, "the line is taller than its digits"


def test_the_status_is_above_the_controls_of_a_phone_and_shown_by_one_tap(restored_desk):
    desk = restored_desk
    desk.page.set_viewport_size({"width": 390, "height": 844})
    bar = desk.page.get_by_role("button", name="Expand panel Planner")

    def box(of: Locator) -> Mapping[str, Any]:
        return of.bounding_box() or {"x": 0.0, "y": np.inf, "width": 0.0, "height": 0.0}

    desk.settled(lambda: box(bar)["y"], "the layout")
    play = box(desk.page.get_by_role("button", name="Play", exact=True))
    assert box(bar)["y"] + box(bar)["height"] <= play["y"] < 844 - play["height"]
    bar.click()
    figure = desk.page.get_by_text("distance to goal")
    figure.wait_for()
    assert desk.settled(lambda: box(figure)["y"], "the status") < 844 - box(figure)["height"]
    desk.page.get_by_role("button", name="Collapse panel Planner").click()
    bar.wait_for()
    desk.page.set_viewport_size({"width": 1000, "height": 600})
