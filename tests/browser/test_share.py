"""Flights as files: the page from disk without a network, the video, and mistakes."""

import base64
import io
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from small_source import small_source

from aero_planner import PlannerConfig
from aero_viz.dashboard.share import share
from aero_viz.dashboard.share.pictures import write_video
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from tests.browser.pictures import differing

TIMEOUT = 120_000.0


@pytest.fixture(scope="module")
def shared(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first second through the forest, as a page."""
    del browser  # skips where there is none
    path = tmp_path_factory.mktemp("share") / "forest.html"
    source = FlightSource(scene("forest", seed=3), seed=3)
    config = PlannerConfig.preset("paper")
    share(source, path, command="aero-viz demo forest --seed 3", config=config, duration=1.0)
    return path


def open_offline(browser: Browser, path: Path) -> Page:
    """The page, opened from disk without a network and paused; fails if it asks for anything."""
    context = browser.new_context(viewport={"width": 640, "height": 400}, offline=True)
    context.set_default_timeout(TIMEOUT)
    page = context.new_page()
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    page.locator(".mantine-NumberInput-input").wait_for()
    page.keyboard.press("Space")
    assert not [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    return page


def picture(page: Page, time_s: float) -> np.ndarray:
    """The left half of the page shortly after going to a time [s], without the figures."""
    page.locator(".mantine-NumberInput-input").fill(f"{time_s:g}")
    page.locator("#aero-time", has_text=f"{time_s:.1f} s").wait_for()
    page.wait_for_timeout(500)
    return iio.imread(io.BytesIO(page.screenshot()))[:340, 300:460, :3]


def test_a_shared_page_plays_and_goes_to_any_time_from_disk_without_a_network(browser, shared):
    assert shared.stat().st_size < 15e6 / 4
    page = open_offline(browser, shared)

    def goes_and_returns() -> bool:
        first, other, again = (picture(page, time_s) for time_s in (0.2, 0.9, 0.2))
        return differing(first, other) > 300 and differing(first, again) < 100

    deadline = time.monotonic() + 1e-3 * TIMEOUT
    while not goes_and_returns():  # the page may still draw what it showed before
        assert time.monotonic() < deadline
    assert page.locator("#aero").inner_text().startswith("forest")
    speed = page.locator(".mantine-Select-input")
    assert speed.evaluate("e => e.value === '1x' && e.scrollWidth <= e.clientWidth"), "the speed is not cut"
    assert "--seed 3" in (page.locator("#aero code").text_content() or "")
    page.locator(".mantine-NumberInput-input").blur()  # Space in the field is typed
    page.keyboard.press("Space")
    before = page.locator("#aero-time").inner_text()
    page.wait_for_function("before => document.getElementById('aero-time').textContent != before", arg=before)
    page.context.close()


def test_the_legend_of_a_shared_page_has_the_costs_of_the_time_that_is_shown(browser, shared):
    page = open_offline(browser, shared)
    worst = page.locator("#aero .aero-low").first
    texts = []
    for time_s in (0.2, 0.9, 0.2):
        picture(page, time_s)
        texts.append(worst.text_content())
    assert texts[0] == texts[2] != texts[1] and str(texts[0]).startswith("worst: ")
    page.context.close()


RECORD_PICTURES = """
() => {
  const request = window.requestAnimationFrame.bind(window), canvas = document.querySelector("canvas[data-engine]");
  const copy = Object.assign(document.createElement("canvas"), {width: 320, height: 180});
  window.pictures = new Map();
  window.requestAnimationFrame = (draw) => request((time) => {
    draw(time);
    copy.getContext("2d").drawImage(canvas, 0, 0, copy.width, copy.height);
    window.pictures.set(time, copy.toDataURL());
  });
}
"""
"""Script that keeps what the scene shows at the end of each animation frame."""


def shown_pictures(page: Page) -> list[np.ndarray]:
    """All pictures of the scene since `RECORD_PICTURES`."""
    urls = page.evaluate("() => [...window.pictures.values()]")
    return [iio.imread(base64.b64decode(url.partition(",")[2]))[..., :3] for url in urls]


def test_no_picture_after_a_jump_back_shows_lines_of_another_time(browser, shared):
    page = open_offline(browser, shared)
    page.locator("canvas[data-engine]").wait_for()
    page.evaluate(RECORD_PICTURES)
    picture(page, 0.9)
    page.wait_for_function("window.pictures.size > 1")
    page.wait_for_timeout(500)
    page.evaluate("() => { const last = [...window.pictures].at(-1); window.pictures = new Map([last]); }")
    picture(page, 0.1)
    page.wait_for_timeout(1000)
    pictures = shown_pictures(page)
    before, after = pictures[0], pictures[-1]
    assert differing(before, after) > 100, "the jump"
    mixed = [min(differing(shown, before), differing(shown, after)) for shown in pictures]
    assert max(mixed) < 50
    page.context.close()


def test_a_shared_page_becomes_a_video(shared, tmp_path):
    path = tmp_path / "flight.mp4"
    options = {"duration": 0.2, "size": (320, 200), "report": lambda _: None}
    with ThreadPoolExecutor(1) as pool:  # Playwright's event loop is on this thread
        pool.submit(write_video, shared, path, **options).result()
    pictures = iio.imread(path, plugin="FFMPEG")
    assert pictures.shape[1:] == (200, 320, 3) and len(pictures) == 6
    assert pictures[0].std() > 5.0 and differing(pictures[0], pictures[-1]) > 20


def test_a_video_on_a_full_disk_is_refused(shared, tmp_path):
    (tmp_path / "flight.mp4").symlink_to("/dev/full")
    options = {"duration": 0.2, "size": (320, 200), "report": lambda _: None}
    with ThreadPoolExecutor(1) as pool, pytest.raises(UserError, match=r"The video cannot be encoded: .*space"):
        pool.submit(write_video, shared, tmp_path / "flight.mp4", **options).result()


def test_a_shared_log_is_a_recording(tmp_path):
    from aero_viz.catalog import open_source

    path = tmp_path / "flight.mcap"
    share(small_source(), path, command="", duration=0.2)
    source = open_source(str(path))
    try:
        assert source.info.recorded_plan is not None and source.info.times is not None
        assert source.info.times[-1] == pytest.approx(0.2)
    finally:
        source.close()


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("flight", {}, "does not say what to write"),
        ("no/such/flight.html", {}, "There is no folder"),
        ("flight.html", {"layers": ["clouds"]}, "no layer 'clouds'"),
    ],
)
def test_mistakes_are_reported_and_leave_no_file(tmp_path, name, options, words):
    with pytest.raises((UserError, ValueError), match=words):
        share(small_source(), tmp_path / name, command="", duration=0.1, **options)
    assert not list(tmp_path.iterdir())
