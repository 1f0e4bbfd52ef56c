"""A progress bar for long work, on a terminal only."""

from __future__ import annotations

import sys
import time
from typing import TextIO

import numpy as np
from numpy.typing import ArrayLike

from aero_viz.scenes.world import World

__all__ = ["ProgressBar", "share_of_way"]

_WIDTH = 24
_PERIOD = 0.2  # [s] between two drawings


class ProgressBar:
    """Draws one line on stderr, at most five times a second; nothing where that is no terminal.

    Call it as a `Progress` of `FlightBatch.run`; `show_way` is a `Way` of `fly`.

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
        """Show how many flights are over, and the time flown [s]; the last call, when all are, is always drawn."""
        self._draw(finished / total, f"{finished}/{total} flights", simulated, last=finished == total)

    def show_way(self, share: float, simulated: float) -> None:
        """Show how much of a single flight's way is behind it, and the time flown [s]."""
        self._draw(share, f"{100.0 * share:.0f} % of the way", simulated)

    def close(self) -> None:
        """Clear the line if it is still there."""
        if self._drawn >= 0.0:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def _draw(self, share: float, done: str, simulated: float, *, last: bool = False) -> None:
        elapsed = time.monotonic() - self._started
        if not self._stream.isatty() or (not last and 0.0 <= self._drawn > elapsed - _PERIOD):
            return
        full = int(_WIDTH * share)
        bar = "#" * full + "." * (_WIDTH - full)
        text = f"{self._label} [{bar}] {done}, {simulated:.1f} s flown in {elapsed:.0f} s"
        self._stream.write(f"\r\x1b[K{text.strip()}" + ("\n" if last else ""))
        self._stream.flush()
        self._drawn = -1.0 if last else elapsed


def share_of_way(world: World, position: ArrayLike) -> float:
    """Return how much of the way from start to goal is behind a drone at `position` [m], shape [3], from 0 to 1."""
    whole = float(np.linalg.norm(world.goal - world.start))
    left = float(np.linalg.norm(world.goal - np.asarray(position, dtype=np.float64)))
    return max(0.0, 1.0 - left / whole) if whole > 0.0 else 1.0
