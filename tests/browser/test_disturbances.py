"""Wind and faults of the sensors that change while it flies, and the drone that is dragged while time stands still."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aero_viz.dashboard.panels.base import ARROWS
from aero_viz.flight.conditions import LIVE
from tests.browser.desk import Desk, open_desk, quick_forest

TITLES = {info.path: info.title for info in LIVE}


@pytest.fixture(scope="module")
def desk(browser):
    """A flight through the forest, paused."""
    with open_desk(browser, quick_forest(), ticks=10, size=(1280, 800), resolution=0.5, layers=["drone"]) as desk:
        desk.open_tab("World")
        yield desk
        assert desk.console == [] and desk.dashboard.failures == 0


def conditions(desk: Desk) -> Any:
    return desk.session.frame.observation.conditions  # type: ignore[union-attr]


def field(desk: Desk, path: str):
    return desk.control(TITLES[path]).filter(visible=True).locator("input").first  # the Fly tab has the same names


def test_a_slider_acts_while_it_flies_and_going_back_restores_what_was_there(desk):
    before, start = conditions(desk), desk.session.frame.index
    desk.session.set_speed(0.1)
    desk.session.play()
    desk.wait_for(lambda: desk.session.frame.index > start, "the flight")
    row = desk.control(TITLES["lidar.dropout"])
    row.locator("xpath=../following-sibling::*[1]").get_by_role("slider").focus()
    desk.page.keyboard.press("End")
    desk.wait_for(lambda: conditions(desk)["lidar.dropout"] == 1.0, "a LiDAR without returns")
    assert desk.session.playing
    desk.session.pause()
    desk.session.step(8).result()
    last = desk.session.frame.observation.sweeps
    assert min(len(sweep) for sweep in last) < 0.5 * max(len(sweep) for sweep in last)
    desk.session.set_speed(1.0)
    desk.session.seek(0.1).result()
    assert conditions(desk) == before
    desk.wait_for(
        lambda: float(field(desk, "lidar.dropout").input_value()) == before["lidar.dropout"], "the old number"
    )


def test_wind_needs_no_other_setting_and_a_refused_number_returns(desk):
    gusts = field(desk, "drone.gust_speed")
    desk.enter(gusts, "4")
    desk.wait_for(lambda: conditions(desk)["drone.gust_speed"] == 4.0, "gusts")
    assert conditions(desk)["drone.drag"] > 0.0
    desk.page.wait_for_timeout(1200)
    desk.enter(gusts, "-2")
    refusal = desk.refusal("drone.gust_speed")
    refusal.wait_for()
    desk.dismiss(refusal)
    desk.wait_for(lambda: float(gusts.input_value()) == 4.0, "the number that stays")


def test_lost_sweeps_and_latency_belong_to_their_tick(desk):
    desk.session.seek(0.0).result()
    before = conditions(desk)
    desk.session.seek(0.1).result()
    for path, value in (("lidar.sweep_loss", 1.0), ("drone.latency", 0.1)):
        desk.enter(field(desk, path), value)
        desk.wait_for(lambda path=path, value=value: conditions(desk)[path] == value, f"{path} {value}")
        desk.page.wait_for_timeout(1200)
    desk.session.step(60).result()
    desk.page.get_by_text("no cloud").wait_for()
    desk.enter(field(desk, "drone.latency"), "3")
    refusal = desk.refusal("at most 0.5 s")
    refusal.wait_for()
    desk.dismiss(refusal)
    desk.session.seek(0.0).result()
    assert conditions(desk) == before


def test_the_drone_is_dragged_only_while_time_stands_still(desk):
    desk.session.seek(0.0).result()
    desk.checkbox("Drag the drone").click()
    before = np.asarray(desk.session.frame.observation.actual_state.position)
    x, y = desk.place_on_page(before)
    tip = x, y - 0.85 * ARROWS["scale"]

    def blue() -> int:
        image = desk.screenshot().astype(int)
        return int(((image[..., 2] > 200) & (image[..., 0] < 90) & (image[..., 1] < 170)).sum())

    desk.wait_for(lambda: blue() > 50, "the arrows")
    desk.drag(tip, (0.0, -50.0))
    desk.wait_for(lambda: desk.session.frame.observation.actual_state.position[2] > before[2] + 0.2, "a higher drone")
    desk.session.set_speed(0.1)
    desk.session.play()
    desk.wait_for(lambda: blue() < 10, "no arrows during the flight")
    desk.session.pause()
