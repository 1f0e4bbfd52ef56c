"""A page that is open before the session."""

import contextlib

import numpy as np
from playwright.sync_api import Browser

from aero_viz.dashboard import Dashboard, LocalServer
from aero_viz.dashboard.first_picture import show_first_picture
from aero_viz.session import Session
from tests.browser.desk import COARSE, quick_forest, visit


def test_a_page_that_is_open_shows_the_points_first_and_then_everything(browser: Browser):
    with contextlib.ExitStack() as stack:
        server = LocalServer(port=0)
        page = visit(browser, server.url, resolution=COARSE)
        stack.callback(page.close)
        session = Session(quick_forest())
        stack.callback(session.close)
        session.start(play=False)
        drawn = show_first_picture(session, server, is_over=lambda: False)
        image = np.asarray(server.get_clients().popitem()[1].get_render(300, 400, transport_format="png"))
        assert (image[..., 3] > 0).mean() > 0.005  # points and rollouts; all else is transparent
        assert page.get_by_role("button", name="Play").count() == 0
        dashboard = Dashboard(session, server=server, drawn=drawn)
        stack.callback(dashboard.close)
        page.get_by_role("button", name="Play").wait_for()
