"""Clicks in the scene and the selection belong to the tab that is open."""

import pytest

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.scenery import ObstacleLayer
from aero_viz.dashboard.layers.selection import SelectionLayer
from aero_viz.scenes import scene
from tests.browser.desk import COARSE, Desk, open_desk, quick_forest
from tests.browser.pictures import count

TREES = 20
FOREST = scene("forest", seed=0, count=TREES)
LAYERS = ["obstacles", "selection", "rollouts", "drone"]


@pytest.fixture(scope="module")
def desk(browser):
    """A flight that Why explains, and whose obstacles are edited."""
    size = (1280, 720)
    with open_desk(browser, quick_forest(count=TREES), ticks=10, size=size, resolution=COARSE, layers=LAYERS) as desk:
        desk.open_tab("World")
        desk.checkbox("Edit obstacles").click()
        desk.open_tab("Why")
        desk.checkbox("Explain the plan").click()
        desk.page.locator(".aero-terms").first.wait_for()
        yield desk
        assert desk.console == [] and desk.dashboard.failures == 0


def selected_instance(desk: Desk) -> int | None:
    layer = desk.dashboard.layers["selection"]
    assert isinstance(layer, SelectionLayer)
    return layer.instance


def selected_obstacle(desk: Desk) -> object:
    layer = desk.dashboard.layers["obstacles"]
    assert isinstance(layer, ObstacleLayer)
    return layer.selected


def magenta(desk: Desk) -> int:
    return count(desk.screenshot(), palette.SELECTED, tolerance=16)


def test_a_click_is_for_the_tab_that_is_open(desk):
    spot = desk.place_on_page(desk.session.frame.plan.anchors[desk.session.frame.plan.best])
    desk.page.mouse.click(*spot)
    desk.wait_for(lambda: selected_instance(desk) is not None, "an instance")
    assert selected_obstacle(desk) is None
    desk.page.get_by_role("button", name="none", exact=True).click()
    desk.wait_for(lambda: selected_instance(desk) is None, "no instance")
    desk.open_tab("World")
    desk.click("Throw an obstacle")
    desk.page.get_by_text(f"Selected: sphere {len(FOREST.spheres)}").wait_for()
    desk.page.mouse.click(*spot)
    desk.page.evaluate("() => new Promise((sent) => setTimeout(sent, 300))")
    assert selected_instance(desk) is None
    desk.page.mouse.click(600.0, 650.0)  # nothing but ground
    desk.page.get_by_text("Click an obstacle").first.wait_for()


def test_a_selection_is_hidden_while_its_tab_is_not_open(desk):
    desk.open_tab("Why")
    desk.page.get_by_role("button", name="5", exact=True).click()
    desk.wait_for(lambda: magenta(desk) > 20, "the selection in the scene")
    desk.open_tab("Fly")
    desk.wait_for(lambda: magenta(desk) == 0, "no selection")
    desk.open_tab("Why")
    desk.wait_for(lambda: magenta(desk) > 20, "the selection again")
    assert desk.page.locator(".aero-verdict").count() == 1
