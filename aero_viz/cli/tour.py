"""The page of `aero-viz demo --tour`."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from aero_planner.plain_text import say
from aero_viz.cli.serving import PageFlags, announce, serve_others, shutdown_event

if TYPE_CHECKING:
    from aero_planner.config import DroneConfig
    from aero_viz.session.source import Opener


def serve_tour(opener: Opener, config: DroneConfig, page_flags: PageFlags, *, seed: int, device: str) -> None:
    """Show the scenes of the tour until Ctrl-C or SIGTERM.

    Args:
        opener: opens the scenes.
        config: configuration of the planner.
        page_flags: the page.
        seed: seed of the planner's noise.
        device: Warp device of the planner.
    """
    from aero_viz.dashboard import Dashboard
    from aero_viz.dashboard.tour import STOPS, Tour
    from aero_viz.session import Session

    with contextlib.ExitStack() as stack:
        session = Session(opener(STOPS[0].scene, seed=seed), config=config, device=device, seed=seed)
        stack.callback(session.close)
        shutdown = shutdown_event()
        dashboard = Dashboard(session, **page_flags.server_options, panels=False)
        stack.callback(dashboard.close)
        serve_others(stack, session, page_flags)
        announce("the tour", dashboard.server, page_flags)
        session.start(play=False)
        Tour(session, dashboard, opener, say=lambda line: say(line, flush=True)).run(shutdown)
