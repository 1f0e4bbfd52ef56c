"""A loop with absolute deadlines, and how well it keeps them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["DeadlineStatistics", "PeriodicLoop"]

_KEPT = 30_000
"""Ticks: ten minutes at 50 Hz."""


class DeadlineStatistics:
    """Lateness of the last ticks and counts of all. Written by one thread, read by any.

    Args:
        period: of the loop [s].
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.ticks = 0
        self.missed = 0
        """Periods in which no tick began."""
        self._late: deque[float] = deque(maxlen=_KEPT)
        self._intervals: deque[float] = deque(maxlen=_KEPT)
        self._last: float | None = None

    def tick(self, due: float, now: float, missed: int = 0) -> None:
        """Count a tick that was due at `due` [s] and begins at `now` [s], after `missed` skipped ones."""
        self.ticks += 1
        self.missed += missed
        self._late.append(now - due)
        if self._last is not None:
            self._intervals.append(now - self._last)
        self._last = now

    def summary(self) -> dict[str, Any]:
        """Return ticks, missed, and of the last ten minutes median, 99 % and largest lateness and the jitter [ms].

        Jitter is the standard deviation of the time between two ticks.
        """
        late = 1e3 * np.array(self._late)
        jitter = 1e3 * float(np.std(self._intervals)) if len(self._intervals) > 1 else None
        median, high = np.quantile(late, (0.5, 0.99)).tolist() if len(late) else (None, None)
        return {
            "period_ms": 1e3 * self.period,
            "ticks": self.ticks,
            "missed": self.missed,
            "late_median_ms": median,
            "late_p99_ms": high,
            "late_max_ms": float(late.max()) if len(late) else None,
            "jitter_ms": jitter,
        }


class PeriodicLoop:
    """Calls a function at a fixed rate until told to stop; calls that take too long never bunch up.

    Args:
        period: [s].
        call: what to do at each deadline.
        clock: host time [s].
        stopped: ends the loop.
        on_grid: after a late call wait for the next deadline, so that all stay multiples of the period; otherwise call
            again at once and count from there.
    """

    def __init__(
        self,
        period: float,
        call: Callable[[], Any],
        *,
        clock: Callable[[], float],
        stopped: threading.Event,
        on_grid: bool = True,
    ) -> None:
        self.statistics = DeadlineStatistics(period)
        self._call = call
        self._clock = clock
        self._stopped = stopped
        self._on_grid = on_grid

    def run(self) -> None:
        """Run the loop in the calling thread."""
        period = self.statistics.period
        due = self._clock()
        missed = 0
        while True:
            # An event wakes as precisely as a sleep, and ends at once.
            if self._stopped.wait(max(0.0, due - self._clock())):
                return
            self.statistics.tick(due, self._clock(), missed)
            self._call()
            now = self._clock()
            missed = max(0, int((now - due) / period))
            due = due + (1 + missed) * period if self._on_grid else max(due + period, now)
