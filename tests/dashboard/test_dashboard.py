"""Handling of frames, without a browser."""

from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.panels.why import WhyPanel
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, read_until, send


def test_a_late_frame_belongs_to_its_own_source():
    session = Session(small_source(), config=small_config())
    dashboard = Dashboard(session, port=0)
    old = session.tick()
    dashboard.changes(old)
    before = session.source
    assert dashboard.source is before
    session.set_source(small_source(goal=20.0)).result()
    dashboard.changes(old)
    assert dashboard.source is before
    new = session.frame
    assert new is not None
    dashboard.changes(new)
    assert dashboard.source is session.source is not before
    dashboard.close()
    session.close()


def test_another_source_ends_the_selection_of_an_instance():
    session = Session(small_source(), config=small_config())
    dashboard = Dashboard(session, port=0)
    dashboard.changes(session.tick())
    why = next(panel for panel in dashboard.panels if isinstance(panel, WhyPanel))
    rollouts = dashboard.layers["rollouts"]
    assert isinstance(rollouts, RolloutLayer)
    why.select(3)
    assert rollouts.selected == 3
    session.set_source(small_source(goal=20.0)).result()
    assert session.frame is not None
    dashboard.changes(session.frame)
    assert rollouts.selected is None
    dashboard.close()
    session.close()


def test_the_tab_of_the_browser_is_named_after_the_source_that_is_open():
    session = Session(small_source(), config=small_config())
    session.tick()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as page:
        send(page, **CAMERA)
        read_until(page, 'document.title = "poles - AERO-Viz"')
        session.set_source(FlightSource(scene("forest", seed=5, count=3))).result()
        read_until(page, 'document.title = "forest-3-5 - AERO-Viz"')
        dashboard.close()
    session.close()
