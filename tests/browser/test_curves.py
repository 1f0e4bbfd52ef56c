"""Curves, events and forks of a flight, through the page."""

import csv

import pytest

from aero_viz.dashboard import palette
from tests.browser.desk import open_desk
from tests.browser.pictures import count


@pytest.fixture(scope="module")
def desk(browser):
    """A flight of 41 ticks that the page has seen from the start."""
    with open_desk(browser, ticks=1, size=(1280, 720), layers=["drone", "trail", "ghost"]) as desk:
        desk.session.step(40).result()
        desk.wait_for(lambda: len(desk.dashboard.history.past().rows) == 41, "all ticks")
        desk.open_tab("Curves")
        desk.page.locator(".aero-curve").first.wait_for()
        yield desk
        assert desk.console == []
        assert desk.dashboard.failures == 0


def points(desk, name: str) -> int:
    lines = desk.page.locator(f'.aero-curve[data-curve="{name}"] polyline')
    return sum(len(line.get_attribute("points").split()) for line in lines.all())


def cursor(desk) -> float:
    return float(desk.page.locator(".aero-cursor").get_attribute("x1"))


@pytest.mark.parametrize("name", ["speed", "clearance", "cost", "plan_ms", "safe", "samples"])
def test_every_tick_is_on_the_curve(desk, name):
    desk.wait_for(lambda: points(desk, name) >= 41, "a point for every tick")
    box = desk.page.locator(f'.aero-curve[data-curve="{name}"]').bounding_box()
    assert box["x"] > 900 and box["x"] + box["width"] <= 1280, "nothing is cut off"


def test_the_cursor_follows_the_time(desk):
    desk.wait_for(lambda: cursor(desk) == pytest.approx(300.0), "a cursor at the end")
    desk.session.seek(0.4).result()
    desk.wait_for(lambda: cursor(desk) == pytest.approx(146.0, abs=6.0), "a cursor in the middle")
    assert points(desk, "speed") >= 41, "the curve stays whole"
    desk.session.seek(0.8).result()


def test_each_line_of_a_heading_stays_one_line_above_its_curve_in_a_narrow_panel(desk):
    heights, gaps = desk.page.evaluate("""() => {
      const headings = [...document.querySelectorAll(".aero-heading")];
      const boxes = elements => elements.map(element => element.getBoundingClientRect());
      headings.forEach(heading => heading.style.width = "200px");
      const lines = boxes(headings.flatMap(heading => [...heading.children]));
      const gaps = headings.map(heading => heading.nextElementSibling.getBoundingClientRect().top
        - Math.max(...boxes([...heading.querySelectorAll("*")]).map(box => box.bottom)));
      headings.forEach(heading => heading.style.width = "");
      return [lines.map(box => box.height), gaps];
    }""")
    assert len(heights) == 8 and max(heights) < 20.0
    assert min(gaps) > -0.5


def test_the_saved_table_has_every_tick(desk, tmp_path):
    with desk.download("Download CSV", tmp_path).open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 41
    assert {"time", "speed", "clearance", "cost", "plan_ms", "safe", "clear", "samples"} <= rows[0].keys()


def test_a_changed_weight_leaves_the_old_future_as_a_ghost(desk):
    desk.session.seek(0.4).result()
    desk.session.configure({"vehicle.speed_limit": 1.0})
    desk.session.step(15).result()
    desk.page.get_by_text("continued from an earlier tick").wait_for()
    desk.page.locator(".aero-event").first.wait_for()
    desk.page.get_by_text("Speed limit [m/s]: 7 → 1").wait_for()
    assert desk.dashboard.history.past().differs_at == pytest.approx(0.42, abs=0.05)
    desk.wait_for(lambda: count(desk.screenshot(), palette.GHOST, tolerance=40) > 20, "the path of the ghost")
    for name in ("speed", "clearance", "cost", "plan_ms"):
        desk.page.locator(f'.aero-curve[data-curve="{name}"] .aero-ghost').first.wait_for(state="attached")  # it stays
    mark = float(desk.page.locator(".aero-differs").get_attribute("x1"))
    assert mark == pytest.approx(300.0 * (0.42 - 0.0) / 0.82, abs=20.0), "where the two first differ"
    table = desk.page.locator(".aero-fork").inner_text()
    assert all(word in table for word in ("before", "now", "outcome", "smallest clearance"))
    desk.open_tab("Layers")
    desk.checkbox("Ghost: A, or before the fork").click()
    desk.wait_for(lambda: count(desk.screenshot(), palette.GHOST, tolerance=40) == 0, "no ghost")
