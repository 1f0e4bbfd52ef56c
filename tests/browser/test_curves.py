"""Curves, events and forks of a flight, in the dock below the scene."""

import csv
import dataclasses
import io
from collections.abc import Iterator
from typing import Any

import imageio.v3 as iio
import pytest
from playwright.sync_api import Browser, Locator

from aero_viz.dashboard import palette
from aero_viz.dashboard.viser_private import CHARTS
from aero_viz.logs import flight_recorder
from aero_viz.session import Session
from tests.browser.desk import COARSE, Desk, open_desk, quick_forest, visit
from tests.browser.pictures import count, ghost_pixels

TICKS, END = 41, 0.82
LANE = ".uplot-container:has(.u-label:text-is('{}'))"


@pytest.fixture(scope="module")
def desk(browser: Browser) -> Iterator[Desk]:
    """A flight of 41 ticks that the page has seen from the start."""
    with open_desk(browser, quick_forest(), ticks=1, size=(1280, 720), layers=["drone", "trail", "ghost"]) as desk:
        desk.session.step(TICKS - 1).result()
        desk.wait_for(lambda: len(desk.dashboard.history.past().rows) == TICKS, "all ticks")
        desk.click("Curves")
        lane(desk, "speed [m/s]").wait_for()
        yield desk
        assert desk.console == []
        assert desk.dashboard.failures == 0


def lane(desk: Desk, title: str) -> Locator:
    return desk.page.locator(LANE.format(title))


def lanes(desk: Desk) -> list[str]:
    return desk.page.locator(".u-legend .u-series:first-child .u-label").all_inner_texts()


def values(desk: Desk, title: str) -> list[list[float]]:
    """Return the times and the values that a lane draws."""
    script = f"title => {CHARTS}.find(c => c.series[0].label === title)?.data.map(column => Array.from(column)) ?? []"
    return desk.page.evaluate(script, title)


def seen(desk: Desk) -> list[list[float]]:
    """Return the first and the last time of each lane."""
    return desk.page.evaluate(f"{CHARTS}.map(({{scales}}) => [scales.x.min, scales.x.max])")


def shown_value(desk: Desk, title: str) -> str:
    return lane(desk, title).locator(".u-value").nth(1).inner_text()


def place(desk: Desk, title: str, time: float) -> tuple[float, float]:
    """Return where a time is on a lane [pixels]."""
    box = lane(desk, title).locator(".u-over").bounding_box()
    (low, high), *_ = seen(desk)
    assert box is not None
    return box["x"] + (time - low) / (high - low) * box["width"], box["y"] + box["height"] / 2.0


def value_at(desk: Desk, name: str, time: float) -> float:
    past = desk.dashboard.history.past()
    return float(past.column(name)[abs(past.rows[:, 0] - time).argmin()])


def test_every_tick_is_on_the_curves_of_flight_and_plan(desk):
    assert lanes(desk)[:3] == ["speed [m/s]", "clearance [m]", "cost of the choice"]
    past = desk.dashboard.history.past()
    desk.wait_for(lambda: len((values(desk, "speed [m/s]") or [[]])[0]) == TICKS, "every tick")
    assert values(desk, "speed [m/s]")[1] == pytest.approx(past.column("speed").tolist())
    costs = values(desk, "cost of the choice")
    assert costs[2] == pytest.approx(past.column("goal_cost").tolist())
    assert seen(desk)[0] == pytest.approx(past.rows[[0, -1], 0])
    assert desk.page.locator(".aero-ruler span").count() > 4, "the axis of time"


def test_the_values_are_those_below_the_mouse_and_else_those_of_the_present_tick(desk):
    desk.page.mouse.move(600.0, 100.0)
    desk.wait_for(lambda: shown_value(desk, "speed [m/s]") == f"{value_at(desk, 'speed', END):.4g}", "the present tick")
    desk.page.mouse.move(*place(desk, "speed [m/s]", 0.2))
    desk.wait_for(
        lambda: shown_value(desk, "speed [m/s]") == f"{value_at(desk, 'speed', 0.2):.4g}", "the tick below the mouse"
    )
    clearance = f"{value_at(desk, 'clearance', 0.2):.4g}"
    desk.wait_for(lambda: shown_value(desk, "clearance [m]") == clearance, "that tick in all lanes")
    desk.page.mouse.move(600.0, 100.0)


def test_a_click_goes_to_its_time_and_the_cursor_follows(desk):
    desk.page.mouse.click(*place(desk, "clearance [m]", 0.4))
    desk.wait_for(lambda: desk.session.frame.time == pytest.approx(0.4), "the tick")
    cursor = "document.querySelector('#aero-curve-state').dataset.now"
    desk.wait_for(lambda: float(desk.page.evaluate(cursor)) == pytest.approx(0.4), "the cursor")
    assert len(values(desk, "speed [m/s]")[0]) == TICKS, "the curve stays whole"
    desk.session.seek(END).result()


def test_a_drag_looks_closer_in_all_lanes_and_a_button_shows_the_whole_flight(desk):
    whole = seen(desk)[0]
    start, end = place(desk, "speed [m/s]", 0.2), place(desk, "speed [m/s]", 0.5)
    desk.drag(start, (end[0] - start[0], 0.0))
    desk.wait_for(lambda: all(span == pytest.approx([0.2, 0.5], abs=0.03) for span in seen(desk)), "a closer look")
    assert desk.session.frame.time == pytest.approx(END), "a drag is no click"
    desk.session.step(1).result()
    desk.wait_for(lambda: len(values(desk, "speed [m/s]")[0]) == TICKS + 1, "another tick")
    assert seen(desk)[0] == pytest.approx([0.2, 0.5], abs=0.03), "it lasts"
    desk.click("Whole flight")
    desk.wait_for(lambda: seen(desk)[0] == pytest.approx([whole[0], whole[1] + 0.02]), "the whole flight")
    desk.session.seek(END).result()


def test_a_visitor_chooses_signals_which_the_browser_remembers_with_the_open_dock(desk, browser):
    desk.page.locator("summary", has_text="Signals").click()
    desk.page.get_by_label("omega_y", exact=True).check()
    desk.page.get_by_label("with clearance", exact=True).check()
    desk.page.get_by_label("of the choice", exact=True).uncheck()
    desk.wait_for(lambda: {"control [rad/s]", "candidates"} <= set(lanes(desk)), "more lanes")
    desk.wait_for(lambda: "effective samples" not in lanes(desk), "one lane less")
    assert desk.page.get_by_label("omega_y", exact=True).is_visible(), "the list stays open"
    desk.wait_for(lambda: len(values(desk, "control [rad/s]")[0]) > TICKS - 1, "its points")
    chosen = lanes(desk)
    with visit(browser, desk.dashboard.url, resolution=COARSE) as other:
        other.get_by_role("button", name="Curves").click()
        other.locator(LANE.format("effective samples")).wait_for()
        assert other.locator(LANE.format("candidates")).count() == 0, "they are the visitor's own"
        other.locator(".u-over").first.click(position={"x": 30.0, "y": 20.0})
        other.locator(".mantine-Notification-root", has_text="You are watching").wait_for()
    assert desk.session.frame.time == pytest.approx(END), "nobody but who has control goes to another time"
    desk.wait_for(lambda: len(desk.dashboard.server.get_clients()) == 1, "the other visitor to leave")
    before = set(desk.dashboard.server.get_clients())
    desk.page.reload()
    desk.wait_for(lambda: before.isdisjoint(desk.dashboard.server.get_clients()), "the page to connect again")
    desk.wait_for(lambda: lanes(desk) == chosen, "the same lanes again")
    desk.page.locator("summary", has_text="Signals").click()
    assert desk.page.get_by_label("omega_y", exact=True).is_checked()
    desk.page.evaluate("localStorage.removeItem('aero-curves')")
    desk.page.reload()
    desk.page.get_by_role("button", name="Curves").wait_for()
    assert not lane(desk, "speed [m/s]").is_visible()
    desk.click("Curves")
    lane(desk, "effective samples").wait_for()


def test_the_saved_table_has_every_tick_and_the_picture_every_lane(desk, tmp_path):
    with desk.download("CSV", tmp_path).open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(desk.dashboard.history.past().rows)
    assert {"time", "speed", "clearance", "cost", "goal_cost", "plan_ms", "samples"} <= rows[0].keys()
    picture = iio.imread(io.BytesIO(desk.download("PNG", tmp_path).read_bytes()))[..., :3]
    assert picture.shape[0] > 70 * len(lanes(desk)) and picture.shape[1] > 800
    assert count(picture, palette.CURVES[0], tolerance=40) > 500, "the curves"


def test_a_changed_weight_leaves_the_old_future_as_a_ghost(desk):
    desk.session.seek(0.4).result()
    desk.session.configure({"vehicle.speed_limit": 1.0})
    desk.session.step(15).result()
    event = desk.page.locator(".aero-event", has_text="Speed limit [m/s]: 7 → 1")
    event.wait_for()
    assert desk.dashboard.history.past().differs_at == pytest.approx(0.42, abs=0.05)
    desk.wait_for(lambda: len(values(desk, "speed [m/s]")) == 3, "the speed of both")
    _, speed, before = values(desk, "speed [m/s]")
    assert None in speed and None not in before[-3:], "each as far as it was flown"
    desk.page.get_by_text("solid: now · dashed: before").wait_for()
    desk.wait_for(lambda: "(" in shown_value(desk, "speed [m/s]"), "the values of both")
    mark = desk.page.evaluate("Number(document.querySelector('#aero-curve-state').dataset.differs)")
    assert mark == pytest.approx(0.42, abs=0.05), "where the two first differ"
    table = desk.page.locator(".aero-fork").inner_text()
    assert all(word in table for word in ("before", "now", "outcome", "smallest clearance"))
    event.click()
    desk.wait_for(lambda: desk.session.frame.time == pytest.approx(0.4), "the tick of the event")
    desk.click("Curves")  # whose mark of the difference has the colour of the ghost
    desk.wait_for(lambda: ghost_pixels(desk.screenshot()) > 20, "the path of the ghost")
    desk.open_tab("Layers")
    desk.checkbox("Ghost: A, or before the fork").click()
    desk.wait_for(lambda: ghost_pixels(desk.screenshot()) == 0, "no ghost")


def test_a_log_is_laid_beside_the_flight(browser, tmp_path):
    path = tmp_path / "yesterday.mcap"
    session = Session(quick_forest())
    with flight_recorder(str(path)) as log:
        for _ in range(25):
            log.write(session.tick())
    session.close()
    with open_desk(browser, quick_forest(), ticks=10, resolution=COARSE, layers=["drone"]) as desk:
        desk.click("Curves")
        desk.open_tab("Tune")
        desk.page.get_by_text("A log beside", exact=True).click()
        desk.enter(desk.control("Log").locator("input"), path)
        desk.click("Show log")
        desk.page.get_by_text("dashed: yesterday.mcap").wait_for()
        desk.wait_for(lambda: len(values(desk, "speed [m/s]")) == 3, "both speeds")
        times, speed, logged = values(desk, "speed [m/s]")
        assert times[-1] > 0.4 and speed[-1] is None and logged[-1] is not None
        desk.session.step(3).result()
        assert desk.dashboard.history.past().ghost_name == "yesterday.mcap", "it stays while the flight goes on"
        desk.click("Hide log")
        desk.wait_for(lambda: len(values(desk, "speed [m/s]")) == 2, "one speed")
        desk.enter(desk.control("Log").locator("input"), "nowhere.mcap")
        desk.click("Show log")
        desk.refusal("There is no file nowhere.mcap").wait_for()
        assert desk.console == [] and desk.dashboard.failures == 0


@pytest.mark.parametrize("size", [(1440, 900), (1024, 700), (390, 844)])
def test_the_dock_is_below_the_scene_and_beside_the_panels(browser, size):
    with open_desk(browser, quick_forest(), ticks=10, size=size, resolution=COARSE, layers=["drone"]) as desk:
        is_phone = size[0] < 576
        if is_phone:
            desk.page.get_by_text("Curves", exact=True).first.click()
        else:
            desk.click("Curves")
        lane(desk, "speed [m/s]").locator(".u-over").wait_for()

        def box(selector: str) -> dict[str, float]:
            found: Any = desk.page.locator(selector).first.bounding_box()
            return {**found, "right": found["x"] + found["width"], "bottom": found["y"] + found["height"]}

        def is_apart() -> bool:
            scene, dock = box("canvas[data-engine]"), box(".aero-curves")
            return scene["bottom"] <= dock["y"] + 1.0

        desk.wait_for(is_apart, "the scene to end above the dock")
        scene, curve = box("canvas[data-engine]"), box(".uplot-container .u-over")
        assert scene["height"] > 0.45 * size[1] and curve["width"] > (0.7 if is_phone else 0.5) * scene["width"]
        assert curve["right"] <= scene["right"] + 1.0 and curve["x"] >= 0.0
        if not is_phone:
            status = ".mantine-Paper-root:has-text('Legend')"
            desk.wait_for(lambda: box(status)["bottom"] <= box(".aero-curves")["y"], "the status above the dock")
        assert desk.console == [] and desk.dashboard.failures == 0


def test_ten_thousand_ticks_are_few_points_that_become_more_where_one_looks_closer(browser):
    with open_desk(browser, quick_forest(), ticks=1, resolution=COARSE, layers=["drone"]) as desk:
        frame = desk.session.frame
        assert frame is not None
        for tick in range(1, 10_000):
            desk.dashboard.history.add(dataclasses.replace(frame, time=0.02 * tick, index=tick))
        desk.click("Curves")
        lane(desk, "speed [m/s]").wait_for()
        desk.wait_for(lambda: seen(desk)[:1] == [pytest.approx([0.02, 199.98])], "the whole flight")
        desk.wait_for(lambda: 0 < len((values(desk, "speed [m/s]") or [[]])[0]) < 3000, "few points")
        start, end = place(desk, "speed [m/s]", 100.0), place(desk, "speed [m/s]", 104.0)
        desk.drag(start, (end[0] - start[0], 0.0))
        inside = lambda: [t for t in values(desk, "speed [m/s]")[0] if 100.5 < t < 103.5]  # noqa: E731
        desk.wait_for(lambda: len(inside()) == 149, "every tick where one looks")
        assert len(values(desk, "speed [m/s]")[0]) < 4000
        assert desk.console == [] and desk.dashboard.failures == 0
