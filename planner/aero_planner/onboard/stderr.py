"""The log on the standard error, which stops nobody who logs."""

from __future__ import annotations

import contextlib
import logging
import os

from aero_planner.mailbox import Mailbox

__all__ = ["StderrHandler", "log_to_stderr"]

_CAPACITY = 1000
"""Lines that may wait; the oldest go."""

_LAST_WORDS = 1.0
"""For what waits when the process ends [s]."""


class StderrHandler(logging.Handler):
    """Writes lines from a thread of its own: a stopped terminal, or a pipe that nobody reads, costs lines, not time."""

    def __init__(self) -> None:
        super().__init__()
        self._lines = Mailbox(_write, capacity=_CAPACITY, name="aero-planner-stderr")

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.put(self.format(record).encode() + b"\n")

    def close(self) -> None:
        self._lines.close(_LAST_WORDS)
        super().close()


def log_to_stderr() -> None:
    """Let this process log to the standard error."""
    form = "%(asctime)s %(levelname)-7s %(message)s"
    logging.basicConfig(level=logging.INFO, format=form, handlers=[StderrHandler()])


def _write(line: bytes) -> None:
    # Not through sys.stderr, whose lock a write that blocks would keep from everyone else, at exit too.
    with contextlib.suppress(OSError):
        while line:
            line = line[os.write(2, line) :]
