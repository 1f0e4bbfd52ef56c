"""The page of a study beside the search that flies it, in a process of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
from multiprocessing.process import BaseProcess

from aero_planner import PlannerConfig
from aero_viz.cli.flags import FlightFlags, WorldFlags
from aero_viz.cli.serving import PageFlags, StudyFlags, shutdown_event


class StudyPage:
    """Serves the page of a study until `wait` or `close`. The flight on the page is paused: the search needs the cores.

    A process of its own neither slows the search nor shares its device memory, and Ctrl-C does not reach it.
    """

    def __init__(
        self,
        world: str,
        world_flags: WorldFlags,
        flight_flags: FlightFlags,
        config: PlannerConfig,
        page_flags: PageFlags,
        *,
        lidar: str,
        seed: int,
        device: str,
    ) -> None:
        self._flags = world, world_flags, flight_flags, config, dataclasses.replace(page_flags, paused=True)
        self._options = {"lidar": lidar, "seed": seed, "device": device}
        self._process: BaseProcess | None = None

    def open(self, study: StudyFlags) -> None:
        """Serve the page."""
        process = multiprocessing.get_context("spawn").Process(
            target=_serve, args=(self._flags, {**self._options, "study": study}), name="aero-viz-page"
        )
        process.start()
        self._process = process

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


def _serve(flags: tuple[str, WorldFlags, FlightFlags, PlannerConfig, PageFlags], options: dict[str, object]) -> None:
    """Serve the page in this process, which ends with its parent. What it prints goes to stderr."""
    os.setpgid(0, 0)  # Ctrl-C in the terminal ends the search only
    threading.Thread(target=_follow_parent, daemon=True).start()
    from aero_viz.cli.page import serve_flight

    with contextlib.redirect_stdout(sys.stderr):
        serve_flight(*flags, log=None, **options)  # type: ignore[arg-type]


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
