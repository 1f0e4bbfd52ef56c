"""A progress bar for long work, on a terminal only."""

from __future__ import annotations

import sys
import time
from typing import TextIO

__all__ = ["ProgressBar"]

_WIDTH = 24
_PERIOD = 0.2  # [s] between two drawings


class ProgressBar:
    """Call it as a `Progress` of `FlightBatch.run`. Draws one line on stderr; nothing where that is no terminal.

    Args:
        label: what is going on.
        stream: None is stderr.
    """

    def __init__(self, label: str = "", *, stream: TextIO | None = None) -> None:
        self._label = label
        self._stream = stream or sys.stderr
        self._started = time.monotonic()
        self._drawn = -1.0

    def __call__(self, finished: int, total: int, simulated: float) -> None:
        """Draw, at most five times a second and always when all is finished."""
        elapsed = time.monotonic() - self._started
        if not self._stream.isatty() or (finished < total and 0.0 <= self._drawn > elapsed - _PERIOD):
            return
        self._drawn = elapsed
        full = _WIDTH * finished // total
        bar = "#" * full + "." * (_WIDTH - full)
        text = f"{self._label} [{bar}] {finished}/{total} flights, {simulated:.1f} s flown in {elapsed:.0f} s"
        self._stream.write(f"\r\x1b[K{text.strip()}" + ("\n" if finished == total else ""))
        self._stream.flush()
