"""Rate of page updates, which gives way to planning."""

from __future__ import annotations

MAX_RATE = 30.0
"""Updates per second while the engine is on time [Hz]."""
MIN_RATE = 20.0
"""Updates per second while the engine is late, if it produces that many frames [Hz]."""
_ON_TIME = 0.94
"""Share of the nominal tick rate from which the engine counts as on time."""
_BACK_OFF, _RETURN = 1.1, 0.98
"""Factors on the time between two updates: it grows quickly and shrinks slowly."""


class UpdateRateLimiter:
    """Spaces the updates of the page, farther apart while the engine is late."""

    def __init__(self) -> None:
        self.period = 1.0 / MAX_RATE
        """Time between the starts of two updates [s]."""
        self._due = 0.0

    def adapt(self, rate: float, nominal_rate: float) -> None:
        """Adapt the period to the engine's tick rate [Hz]."""
        factor = _RETURN if rate >= _ON_TIME * nominal_rate else _BACK_OFF
        self.period = min(max(self.period * factor, 1.0 / MAX_RATE), 1.0 / MIN_RATE)

    def delay(self, now: float) -> float:
        """Return how long to wait before the next update [s], given that the last one ended at `now`.

        The period counts from when that update was due, not from its start. A late update thus delays no others, and
        the next ones make up for up to one period.
        """
        self._due = max(self._due + self.period, now - self.period)
        return max(self._due - now, 0.0)
