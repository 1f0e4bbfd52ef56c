"""Commands to a session from any thread, which the thread that ticks runs between two ticks."""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from aero_viz.errors import UserError

USER_MISTAKES = (UserError, ValueError)
"""Errors of commands that need no traceback."""


class CommandQueue:
    """Holds commands until they are run.

    Args:
        report: called with the error of a command.

    Attributes:
        closed: True cancels the commands that have not been run.
    """

    def __init__(self, report: Callable[[Exception], object]) -> None:
        self._report = report
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self.closed = False

    def put(self, command: Callable[[], Any], *, quiet: bool = False) -> Future[Any]:
        """Add a command and return the future of its result; a quiet one does not report mistakes of the user."""
        future: Future[Any] = Future()

        def run() -> None:
            if self.closed:
                future.cancel()
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(command())
            except Exception as error:
                future.set_exception(error)
                if not (quiet and isinstance(error, USER_MISTAKES)):
                    self._report(error)

        self._waiting.put(run)
        if self.closed:
            future.cancel()
        return future

    def get(self, timeout: float | None = None) -> Callable[[], None] | None:
        """Remove and return the next command, or None if `stop` was called; queue.Empty after `timeout` [s]."""
        return self._waiting.get(timeout=timeout)

    def empty(self) -> bool:
        """Return True if no command waits."""
        return self._waiting.empty()

    def stop(self) -> None:
        """Let `get` return None after all commands."""
        self._waiting.put(None)
