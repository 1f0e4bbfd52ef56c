"""The tour without a browser: its camera, and what its planner knows."""

import threading

import numpy as np

from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.tour import Director, Stop, Tour
from aero_viz.session import Session


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
