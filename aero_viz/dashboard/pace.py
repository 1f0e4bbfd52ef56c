"""How often the page is updated: planning goes before drawing."""

from __future__ import annotations

__all__ = ["FASTEST", "SLOWEST", "Pace"]

FASTEST = 30.0
"""Updates per second when the engine keeps its pace [Hz]."""
SLOWEST = 20.0
""".. and at least, however late the engine is [Hz]; it may have fewer frames to show."""
_ON_TIME = 0.97
"""Share of its ticks that an engine makes which counts as keeping its pace."""
_BACK_OFF, _RETURN = 1.1, 0.98
"""Factors on the time between two updates: off quickly, back slowly."""


class Pace:
    """Time between two updates, longer while the engine makes fewer ticks than it should."""

    def __init__(self) -> None:
        self.period = 1.0 / FASTEST
        """Time between the starts of two updates [s]."""
        self._due = 0.0

    def note(self, rate: float, wanted: float) -> None:
        """Take notice of the engine's ticks per second, and how many they should be."""
        factor = _RETURN if rate >= _ON_TIME * wanted else _BACK_OFF
        self.period = min(max(self.period * factor, 1.0 / FASTEST), 1.0 / SLOWEST)

    def delay(self, now: float) -> float:
        """Return how long the next update has to wait [s], after one that ends at `now`.

        Counted from when this one was due, not from when it began: one that comes late does not delay all others.
        """
        self._due = max(self._due + self.period, now)
        return self._due - now
