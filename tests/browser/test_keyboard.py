"""Keys of the page."""

from __future__ import annotations

import re

import pytest

from aero_viz.dashboard.panels.keys import rows
from tests.browser.desk import COARSE, Desk, visit


@pytest.fixture
def desk(restored_desk: Desk) -> Desk:
    """A paused flight; the mouse has been in the scene last."""
    restored_desk.page.mouse.click(500, 200)
    return restored_desk


def test_ctrl_z_undoes_a_change_of_a_parameter_and_ctrl_shift_z_redoes_it(desk):
    before = desk.session.config.costs.q_track
    desk.session.configure({"costs.q_track": 8.0})
    desk.page.keyboard.press("Control+z")
    desk.wait_for(lambda: desk.session.config.costs.q_track == before, "the weight before")
    desk.page.keyboard.press("Control+Shift+z")
    desk.wait_for(lambda: desk.session.config.costs.q_track == 8.0, "the weight again")


def test_arrows_step_without_turning_the_camera_and_the_space_bar_plays_and_presses_no_button(desk):
    index = desk.session.frame.index
    desk.click("free")
    eye = desk.settled(lambda: desk.camera.position, "the camera to stand still")
    for key, moved in (("Shift+ArrowRight", 10), ("ArrowRight", 11), ("ArrowLeft", 10), ("Shift+ArrowLeft", 0)):
        desk.page.keyboard.press(key, delay=200)
        desk.wait_for(lambda moved=moved: desk.session.frame.index == index + moved, key)
    assert desk.camera.position == pytest.approx(eye)
    desk.click("+1")
    desk.wait_for(lambda: desk.session.frame.index == index + 1, "one tick")
    desk.page.keyboard.press("Space")
    desk.wait_for(lambda: desk.session.playing and desk.session.frame.index > index + 2, "the flight")
    desk.page.keyboard.press("Space")
    desk.wait_for(lambda: not desk.session.playing, "a pause")


def test_keys_do_nothing_in_a_field_or_on_a_slider(desk):
    before, count = desk.session.frame, len(desk.session.frame.world.spheres)
    field = desk.control("Path").locator("input")
    field.fill("")
    desk.page.keyboard.type(" T.,2")
    assert field.input_value() == " T.,2"
    desk.open_tab("Tune")
    slider = desk.page.get_by_role("slider").last
    shown = slider.get_attribute("aria-valuenow")
    slider.focus()
    desk.page.keyboard.press("ArrowRight")
    desk.wait_for(lambda: slider.get_attribute("aria-valuenow") != shown, "another value")
    desk.page.mouse.click(500, 200)
    desk.page.keyboard.press("t")  # keys are in order: what they did before this one is done
    desk.wait_for(lambda: len(desk.session.frame.world.spheres) == count + 1, "the obstacle")
    assert desk.session.frame.index == before.index and not desk.session.playing
    desk.page.keyboard.press("Delete")
    desk.wait_for(lambda: len(desk.session.frame.world.spheres) == count, "its removal")


def test_the_list_has_every_key(desk):
    desk.page.keyboard.press("Shift+?")
    table = desk.page.get_by_role("dialog")
    table.get_by_text("Throw an obstacle").wait_for()
    words = table.inner_text()
    for shown, label in rows():
        assert shown in words and label in words
    desk.page.get_by_role("button", name="Close", exact=True).click()
    table.wait_for(state="hidden")


@pytest.mark.parametrize("key", ["Shift+?", "Escape"])
def test_the_list_is_hidden_by_a_key(desk, key):
    desk.page.keyboard.press("Shift+?")
    table = desk.page.get_by_role("dialog")
    table.get_by_text("Throw an obstacle").wait_for()
    desk.page.keyboard.press(key)
    table.wait_for(state="hidden")


def test_keys_work_after_a_click_on_a_checkbox(desk):
    box = desk.page.get_by_role("checkbox").locator("visible=true").first
    was_checked = box.is_checked()
    box.click()
    desk.page.keyboard.press("Space")
    desk.wait_for(lambda: desk.session.playing, "the flight")
    assert box.is_checked() is not was_checked
    desk.page.keyboard.press("Space")
    desk.wait_for(lambda: not desk.session.playing, "a pause")
    box.click()


def test_the_command_palette_lists_every_key_and_runs_what_is_chosen(desk):
    page = desk.page
    page.keyboard.press("Control+k")
    search = page.get_by_placeholder("Search commands...")
    search.wait_for()
    for shown, label in rows():
        assert page.get_by_text(label, exact=True).count() == 1, label
        command = page.get_by_role("button", name=re.compile(f"^{re.escape(label)}")).first.inner_text()
        assert all(name in command for name in shown.split(" or ")), f"{shown}: {command}"
    index = desk.session.frame.index
    search.fill("ten ticks forw")
    page.get_by_role("button", name="Ten ticks forward").click()
    desk.wait_for(lambda: desk.session.frame.index == index + 10, "ten ticks")
    search.wait_for(state="hidden")
    page.keyboard.press("Control+k")
    search.fill("top")
    page.keyboard.press("Enter")
    drone = desk.session.frame.observation.state.position
    desk.wait_for(lambda: desk.camera.position[2] > drone[2] + 5.0, "the view from above")


def test_a_visitor_who_looks_on_is_told_and_has_keys_for_the_own_camera_and_layers(desk, browser):
    second = visit(browser, desk.dashboard.url, resolution=COARSE)
    second.get_by_text("You are watching; your camera").wait_for()
    before = desk.session.frame
    second.mouse.click(500, 200)
    refusal = second.locator(".mantine-Notification-root", has_text="You are watching").first

    def is_told() -> bool:
        second.keyboard.press("ArrowRight")  # has no effect until the new page has received its keys
        second.wait_for_timeout(500)
        return refusal.is_visible()

    desk.wait_for(is_told, "the refusal")
    first, other = (client.camera for client in desk.dashboard.server.get_clients().values())
    second.keyboard.press("2")
    desk.wait_for(lambda: other.position[2] > 2.0 * first.position[2], "the view from above")
    numbers = list(desk.dashboard.server.get_clients())
    layer = desk.dashboard.layers["obstacles"]
    second.keyboard.press("o")
    desk.wait_for(lambda: layer.is_visible_to(numbers[1]), "the obstacles")
    assert not layer.is_visible_to(numbers[0]) and desk.session.frame is before
    second.close()
