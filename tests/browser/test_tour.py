"""The tour: scenes in turn, a caption, and what happens when a scene fails or the browser is closed."""

import io
import threading
from typing import Any

import imageio.v3 as iio
import numpy as np

from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.tour import Director, Stop, Tour
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
            page = visit(browser, dashboard.url, size=(480, 300))
            page.locator("#aero-caption-text", has_text=".").wait_for()
            seen = tour.shown
            first = iio.imread(io.BytesIO(page.screenshot()))
            while tour.shown < seen + 1:
                page.wait_for_timeout(100)
            second = iio.imread(io.BytesIO(page.screenshot()))
            assert first.std() > 4.0 and (np.abs(first.astype(int) - second).max(axis=-1) > 30).sum() > 200
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


def test_the_camera_of_the_tour_stays_with_the_drone_and_out_of_obstacles():
    session = Session(open_source("random_clutter", seed=0))
    director = Director()
    try:
        for shot in ("chase", "orbit"):
            director.shot = shot
            for _ in range(30):
                frame = session.tick()
                eye, target = director(frame)
                position = np.asarray(frame.observation.actual_state.position)
                assert np.linalg.norm(eye - position) < 8.0 and np.linalg.norm(target - position) < 2.0
                assert frame.world is not None and frame.world.distance(eye[None])[0] > 0.0
    finally:
        session.close()


def test_the_planner_of_the_tour_knows_the_top_of_each_scene():
    session = Session(open_source("pillars", seed=0))
    dashboard = Dashboard(session, port=0, panels=False)
    session.start(play=False)
    shutdown = threading.Event()
    tops: list[tuple[float, float]] = []

    def say(_: str) -> None:
        frame = session.frame
        assert frame is not None and frame.world is not None
        tops.append((frame.config.costs.height_max, float(frame.world.bounds[1, 2])))
        if len(tops) == 2:
            shutdown.set()

    stops = [Stop(name, ("A room.",), seconds=0.2, seed=0) for name in ("double_wall_trap", "pillars")]
    Tour(session, dashboard, open_source, stops=stops, say=say, pause=0.0).run(shutdown)
    dashboard.close()
    session.close()
    assert [top for top, _ in tops] == [top for _, top in tops] and tops[0] != tops[1]
