"""`aero-viz compare`: two flight logs in one table, or on one page."""

from __future__ import annotations

import contextlib
from typing import Annotated

import tyro

from aero_viz.cli.flags import Inline
from aero_viz.cli.output import print_report
from aero_viz.cli.serving import WATCHING, PageFlags, announce, serve_others, shutdown_event, wait_for

_PAGE = PageFlags()
_Log = tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="A.mcap")]]
_OtherLog = tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="B.mcap")]]


def compare(
    a: _Log, b: _OtherLog, *, json: bool = False, page: bool = False, page_flags: Inline[PageFlags] = _PAGE
) -> None:
    """Compare two flight logs: figures, parameters and conditions.

    Args:
        a: Flight log (MCAP) that B is compared with.
        b: Flight log (MCAP).
        json: Print one JSON object.
        page: Show B as the drone and A as the ghost on the page, with the curves on top of each other.
        page_flags: The page.
    """
    from aero_viz.logs.comparison import compare_logs

    if page:
        page_flags.refuse(besides=WATCHING, advice="the page of a comparison opens no files: leave it out")
    else:
        page_flags.refuse(advice="it is for the page: add --page, or leave it out")
    comparison = compare_logs(a, b)
    print_report(comparison, as_json=json)
    if not page:
        return
    from aero_viz.catalog import open_source
    from aero_viz.dashboard import Dashboard
    from aero_viz.dashboard.logged_history import LoggedHistory
    from aero_viz.logs.replay import FlightReplay
    from aero_viz.session import Session

    with contextlib.ExitStack() as stack:
        source = open_source(b)
        session = Session(source, config=comparison.b.config)
        stack.callback(session.close)
        shutdown = shutdown_event()
        history = LoggedHistory(comparison, start=source.start if isinstance(source, FlightReplay) else 0.0)
        dashboard = Dashboard(session, **page_flags.server_options, history=history)
        stack.callback(dashboard.close)
        serve_others(stack, session, page_flags)
        announce(f"{b} with the ghost of {a}", dashboard.server, page_flags)
        session.start(play=not page_flags.paused)
        wait_for(shutdown)
