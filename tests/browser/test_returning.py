"""A page that is loaded again, and controls that change hands."""

import numpy as np

from tests.browser.desk import COARSE, visit


def test_camera_layers_and_tab_survive_a_reload(fresh_desk):
    desk = fresh_desk
    desk.click("top")
    desk.open_tab("Layers")
    cells = desk.dashboard.layers["coarse_cells"]
    desk.checkbox(cells.title).check()
    desk.checkbox("Drone").uncheck()
    desk.wait_for(lambda: cells.visible and not desk.dashboard.layers["drone"].visible, "the layers")
    before = desk.settled(lambda: desk.camera.position, "the view from above")
    first = next(iter(desk.dashboard.server.get_clients()))
    desk.page.reload()
    desk.wait_for(lambda: list(desk.dashboard.server.get_clients()) not in ([first], []), "the page to connect again")
    desk.wait_for(lambda: cells.visible and not desk.dashboard.layers["drone"].visible, "the layers again")
    desk.page.get_by_role("tab", name="Layers", selected=True).wait_for()
    after = desk.settled(lambda: desk.camera.position, "the camera")
    np.testing.assert_allclose(after, before, atol=0.05)
    assert desk.checkbox(cells.title).is_checked() and not desk.checkbox("Drone").is_checked()


def test_whoever_loses_control_is_told(fresh_desk, browser):
    desk = fresh_desk
    with visit(browser, desk.dashboard.url, resolution=COARSE) as other:
        other.get_by_role("button", name="Take control").click()
        desk.page.get_by_text("Another visitor has taken control of the session.").wait_for()
        assert other.get_by_text("Another visitor has taken control of the session.").count() == 0


def test_shared_controls_look_disabled_to_whoever_watches_and_own_ones_do_not(fresh_desk, browser):
    desk = fresh_desk
    opacity = "element => getComputedStyle(element).opacity"
    with visit(browser, desk.dashboard.url, resolution=COARSE) as other:
        play = other.get_by_role("button", name="Play", exact=True)
        desk.wait_for(lambda: play.evaluate(opacity) == "0.4", "shared controls to look disabled")
        assert desk.page.get_by_role("button", name="Play", exact=True).evaluate(opacity) == "1"
        for kind in ("Slider-root", "NumberInput-controls", "NumberInput-input"):
            assert other.locator(f".mantine-{kind}").first.evaluate(opacity) == "0.4", kind
        for name in ("Take control", "top"):
            assert other.get_by_role("button", name=name, exact=True).evaluate(opacity) == "1"
        other.get_by_role("tab", name="Layers").click()
        switch = other.get_by_role("checkbox").first
        desk.wait_for(lambda: switch.evaluate(opacity) == "1", "the layers to look like the visitor's own")
        other.get_by_role("button", name="Take control").click()
        desk.wait_for(lambda: play.evaluate(opacity) == "1", "the controls of whoever holds control")
