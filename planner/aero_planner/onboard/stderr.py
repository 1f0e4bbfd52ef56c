"""Logging to standard error that never blocks the thread that logs."""

from __future__ import annotations

import contextlib
import logging
import os

from aero_planner.mailbox import Mailbox
from aero_planner.plain_text import PlainFormatter

_CAPACITY = 1000
"""Largest number of lines that wait; the oldest are dropped."""

_FINAL_TIMEOUT = 1.0
"""Time for writing the remaining lines when the process ends [s]."""


class StderrHandler(logging.Handler):
    """Writes lines on its own thread, so that a stopped terminal or a full pipe costs lines instead of time."""

    def __init__(self) -> None:
        super().__init__()
        self._lines = Mailbox(_write, capacity=_CAPACITY, name="aero-planner-stderr", low_priority=True)

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.put(self.format(record).encode() + b"\n")

    def close(self) -> None:
        self._lines.finish(_FINAL_TIMEOUT)
        super().close()


def log_to_stderr() -> None:
    """Send this process's log to standard error."""
    line_format = "%(asctime)s %(levelname)-7s %(message)s"
    handler = StderrHandler()
    handler.setFormatter(PlainFormatter(line_format))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def _write(line: bytes) -> None:
    # Not through sys.stderr: a blocked write would hold its lock, and block every other writer, also at exit.
    with contextlib.suppress(OSError):
        while line:
            line = line[os.write(2, line) :]
