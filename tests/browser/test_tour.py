"""The tour: scenes in turn, a caption, and what happens when a scene fails or the browser is closed."""

import io
import threading
from typing import Any

import imageio.v3 as iio
import numpy as np
from playwright.sync_api import Page
from small_source import wait_for

from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.tour import Stop, Tour
from aero_viz.errors import UserError
from aero_viz.session import Session
from tests.browser.desk import TIMEOUT, visit

STOPS = (
    Stop("broken", ("Never shown.",)),
    Stop("pillars", ("Six pillars in a room.",), shot="orbit", seed=0),
    Stop("random_clutter", ("Boxes and balls.",), shot="top", seconds=0.5),
)


def open_stop(spec: str, **options: Any):
    if spec == "broken":
        raise UserError("there is no such scene")
    return open_source(spec, **options)


def picture(page: Page) -> np.ndarray:
    return iio.imread(io.BytesIO(page.screenshot())).astype(int)


def changed_pixels(first: np.ndarray, second: np.ndarray) -> int:
    return int((np.abs(first - second).max(axis=-1) > 30).sum())


def test_the_tour_loops_skips_what_fails_and_survives_a_closed_browser(browser):
    session = Session(open_source("pillars", seed=0))
    dashboard = Dashboard(session, port=0, panels=False)
    session.start(play=False)
    lines: list[str] = []
    shutdown = threading.Event()
    tour = Tour(session, dashboard, open_stop, stops=STOPS, say=lines.append, pause=0.2)
    thread = threading.Thread(target=tour.run, args=(shutdown,))
    thread.start()
    try:
        for _ in range(2):  # closed, and opened again
            page = visit(browser, dashboard.url, size=(480, 300), resolution=0.5)
            page.locator("#aero-caption-text", has_text=".").wait_for()
            seen = tour.shown
            first = picture(page)
            while tour.shown < seen + 1:
                page.wait_for_timeout(100)
            assert first.std() > 4.0
            wait_for(lambda page=page, first=first: changed_pixels(first, picture(page)) > 200)
            assert not page.locator(".mantine-Paper-root").first.is_visible()
            page.close()
        while tour.shown < 4:
            assert thread.is_alive()
            shutdown.wait(0.1)
    finally:
        shutdown.set()
        thread.join(TIMEOUT)
        dashboard.close()
        session.close()
    assert tour.skipped >= 2 and "broken, seed 0: skipped" in lines[0]
    assert any(line.startswith("pillars, seed 0: ") for line in lines) and any(
        "random_clutter, seed 1" in line for line in lines
    )
