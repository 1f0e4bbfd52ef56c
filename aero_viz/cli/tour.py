"""The page of `aero-viz demo --tour`."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aero_planner import PlannerConfig
    from aero_viz.dashboard import Dashboard
    from aero_viz.session.source import Opener

__all__ = ["serve_tour"]


def serve_tour(
    opener: Opener,
    config: PlannerConfig,
    *,
    seed: int,
    device: str,
    announce: Callable[[Dashboard], None],
    shutdown: Callable[[], threading.Event],
    **page: Any,
) -> None:
    """Show the scenes of the tour until Ctrl-C or SIGTERM.

    Args:
        opener: opens the scenes.
        config: configuration of the planner.
        seed: seed of the planner's noise.
        device: Warp device of the planner.
        announce: says where the page is.
        shutdown: returns the event that ends the tour.
        page: other arguments of `Dashboard`.
    """
    from aero_viz.dashboard import Dashboard
    from aero_viz.dashboard.tour import STOPS, Tour
    from aero_viz.session import Session

    with contextlib.ExitStack() as stack:
        session = Session(opener(STOPS[0].scene, seed=seed), config=config, device=device, seed=seed)
        stack.callback(session.close)
        event = shutdown()
        dashboard = Dashboard(session, panels=False, **page)
        stack.callback(dashboard.close)
        announce(dashboard)
        session.start(play=False)
        Tour(session, dashboard, opener, say=lambda line: print(line, flush=True)).run(event)
