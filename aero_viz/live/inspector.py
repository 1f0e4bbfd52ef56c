"""The checks of `aero-viz inspect`, on a stream while it is planned."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import CancelledError
from dataclasses import replace

from aero_planner.mailbox import lower_thread_priority
from aero_viz.errors import UserError
from aero_viz.live.session import StreamSession
from aero_viz.live.setup import Setup, Wanted, find_setup

_log = logging.getLogger(__name__)

_FIRST, _PERIOD = 8.0, 30.0
"""Time until the first look, and between two [s]: one takes seconds of a processor."""

_CLOSE_TIMEOUT = 5.0
"""Longest wait for a look that has begun [s]."""


class Inspector:
    """Looks at the newest seconds of a stream now and then, and tells the session what is new.

    Args:
        session: plans the stream.
        wanted: what the user has settled.
        first, period: time until the first look and between two [s].
    """

    def __init__(
        self, session: StreamSession, wanted: Wanted, *, first: float = _FIRST, period: float = _PERIOD
    ) -> None:
        self._session, self._wanted, self._period = session, wanted, period
        self._told: set[str] = set()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(first,), name="aero-viz-inspector", daemon=True)
        self._thread.start()

    def _run(self, first: float) -> None:
        lower_thread_priority()
        delay = first
        while not self._closed.wait(delay):
            delay = self._period
            if self._session.rests:
                continue  # without clouds, everything looks like a fault
            try:
                self.look()
            except (UserError, CancelledError):
                continue  # the stream is silent, which the session says, or the session is closed
            except Exception:
                _log.exception("the stream cannot be inspected")

    def look(self) -> Setup:
        """Check the newest seconds of the stream, use what they tell, and return it.

        Raises:
            UserError: there is too little to look at.
        """
        source = self._session.stream_source
        used = source.setup
        wanted = replace(self._wanted, points=used.points, odometry=used.poses)
        found = find_setup(source.stream, wanted, faults=True)
        for finding in found.findings:
            if finding.is_fault and finding.code not in self._told:
                self._told.add(finding.code)
                self._session.notify(f"{finding.evidence}. Next: {finding.advice}.", level="failure")
        # What places the cloud stays as it was said at the start.
        twist = "none" if used.twist == "none" else found.twist
        self._session.use(replace(used, twist=twist, measured=found.measured, findings=found.findings)).result()
        return found

    def close(self) -> None:
        """Look no more."""
        self._closed.set()
        self._thread.join(_CLOSE_TIMEOUT)
