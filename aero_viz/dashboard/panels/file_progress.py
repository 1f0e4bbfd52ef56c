"""Progress of a file that is being written."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError

import viser

from aero_viz.dashboard.panels import markup

_PERIOD = 0.3
"""Shortest time between two updates of the progress [s]."""
_ONE_AT_A_TIME = "No other file can be written until this one is done or cancelled."


class FileProgress:
    """A line with the share of a file that is written, and a button that gives it up. Both are hidden otherwise."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._name = ""
        self._notification: viser.NotificationHandle | None = None
        self._is_cancelled = threading.Event()
        self._due = 0.0
        self._line = gui.add_html("", visible=False)
        self._cancel = gui.add_button("Cancel writing", icon=viser.Icon.X, color="red", visible=False)

        @self._cancel.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.cancel()

    def cancel(self) -> None:
        """Give up the file that is being written: the next call of `check` or `report` raises."""
        self._is_cancelled.set()

    @contextlib.contextmanager
    def show(self, name: str, client: viser.ClientHandle) -> Iterator[None]:
        """Show during the context that a file with this name is being written, in a notification for `client` too."""
        self._is_cancelled.clear()
        self._name, self._due = name, 0.0
        notification = client.add_notification("AERO-Viz", f"{name} ..", loading=True, with_close_button=False)
        self._notification = notification
        self._update(f"{name} ..")
        self._line.visible = self._cancel.visible = True
        try:
            yield
        finally:
            with contextlib.suppress(Exception):  # the page may be closed
                notification.remove()
            with contextlib.suppress(Exception):
                self._line.visible = self._cancel.visible = False

    def check(self) -> None:
        """Raise CancelledError if the file is given up."""
        if self._is_cancelled.is_set():
            raise CancelledError(f"{self._name} was not written, since that was cancelled.")

    def report(self, done: float, total: float, what: str) -> None:
        """Show that `done` of `total` [s] of the flight are done, and `what` was done with them.

        Raises:
            CancelledError: the file is given up.
        """
        self.check()
        if (now := time.monotonic()) >= self._due:
            self._due = now + _PERIOD
            self._update(progress(self._name, done, total, what))

    def _update(self, text: str) -> None:
        self._line.content = markup.block(markup.text(text), markup.muted(_ONE_AT_A_TIME))
        assert self._notification is not None
        self._notification.body = text


def progress(name: str, done: float, total: float, what: str) -> str:
    """Return the progress of a file in words, such as "Video: 4.8 of 9.6 s written (50 %)"."""
    share = min(done / total, 1.0) if total > 0.0 else 1.0
    return f"{name}: {done:.1f} of {total:.1f} s {what} ({100.0 * share:.0f} %)"
