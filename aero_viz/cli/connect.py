"""The verb `aero-viz connect`: a drone's live plan on the page."""

from __future__ import annotations

import webbrowser
from typing import Annotated

import tyro

from aero_viz.cli.flags import Inline
from aero_viz.cli.page import PageFlags, told_to_end

__all__ = ["connect"]

_PAGE = PageFlags()


def connect(
    drone: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="HOST")]],
    *,
    drone_port: int = 14650,
    page: Inline[PageFlags] = _PAGE,
) -> None:
    """Show the live plan of a drone that runs `aero-planner run`; the page looks on and steers nothing.

    Args:
        drone: name or address of the drone; its settings must say telemetry.host: 0.0.0.0, or an SSH tunnel lead there.
        drone_port: TCP port of its telemetry.
        page: the page.
    """
    from aero_viz.dashboard import Dashboard
    from aero_viz.session.live_session import LiveSession
    from aero_viz.session.node_client import NodeClient

    session = LiveSession(NodeClient(drone, drone_port), reconnect=lambda: NodeClient(drone, drone_port))
    stopped = told_to_end()
    try:
        dashboard = Dashboard(session, host=page.host, port=page.port)
        try:
            print(f"AERO-Viz shows {drone} at {dashboard.url} (Ctrl-C ends it)", flush=True)
            if page.open:
                webbrowser.open(dashboard.url)
            session.start(play=not page.paused)
            stopped.wait()
        finally:
            dashboard.close()
    finally:
        session.close()
