"""The page of a study, served by a separate process while the search runs."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from multiprocessing.process import BaseProcess

from aero_planner.cli_util import quick_imports
from aero_planner.plain_text import say
from aero_viz.cli.serving import StudyFlags, shutdown_event
from aero_viz.errors import UserError


class StudyPage:
    """Serves the page of a study until `wait` or `close`.

    A separate process neither slows the search nor shares its device memory, and Ctrl-C does not reach it.

    Args:
        serve: serves a page that shows `study`, until SIGTERM. It can be pickled.
    """

    def __init__(self, serve: Callable[..., None]) -> None:
        self._serve = serve
        self._process: BaseProcess | None = None

    def open(self, study: StudyFlags) -> None:
        """Serve the page. Must be called in the main thread."""
        self._process = multiprocessing.get_context("spawn").Process(
            target=_run, args=(partial(self._serve, study=study),), name="aero-viz-page"
        )
        # The process inherits this, for Ctrl-C during its imports.
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._process.start()
        finally:
            signal.signal(signal.SIGINT, handler)

    def wait(self) -> None:
        """Serve the page until Ctrl-C or SIGTERM, or until it has ended."""
        shutdown = shutdown_event()
        while self._process is not None and self._process.is_alive() and not shutdown.wait(0.5):
            pass

    def close(self) -> None:
        """End the page."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()


def _run(serve: Callable[[], None]) -> None:
    """Serve the page in this process, which ends with its parent. What it prints goes to stderr."""
    os.setpgid(0, 0)  # Ctrl-C in the terminal ends the search only
    threading.Thread(target=_follow_parent, daemon=True).start()
    with contextlib.redirect_stdout(sys.stderr):
        try:
            with quick_imports():
                import aero_viz.dashboard  # noqa: F401
            serve()
        except UserError as error:
            say(f"aero-viz: {error} The search goes on without the page.")


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
