"""A loop with absolute deadlines, and statistics of how well it meets them."""

from __future__ import annotations

import logging
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

_log = logging.getLogger(__name__)

_KEPT = 30_000
"""Number of ticks that the statistics cover: ten minutes at 50 Hz."""
_SWITCH_INTERVAL = 0.0005
"""Longest time for which a thread may keep the interpreter from a loop [s]."""


class DeadlineStatistics:
    """Lateness of the last ticks and counts of all ticks. Written by one thread, read by any.

    Args:
        period: Period of the loop [s].

    Attributes:
        period: Period of the loop [s].
        ticks: Number of ticks.
        missed: Number of periods in which no tick began.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.ticks = 0
        self.missed = 0
        self._lateness: deque[float] = deque(maxlen=_KEPT)
        self._intervals: deque[float] = deque(maxlen=_KEPT)
        self._last: float | None = None

    def add_tick(self, due: float, now: float, missed: int = 0) -> None:
        """Add a tick that was due at `due` [s] and began at `now` [s], after `missed` skipped ones."""
        self.ticks += 1
        self.missed += missed
        self._lateness.append(now - due)
        if self._last is not None:
            self._intervals.append(now - self._last)
        self._last = now

    def summary(self) -> dict[str, Any]:
        """Return the counts, and lateness and jitter over the last ten minutes [ms].

        Lateness is given as median, 99th percentile and maximum. Jitter is the standard deviation of the time between
        two ticks.
        """
        late = 1e3 * np.array(self._lateness)
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
    """Calls a function at a fixed rate until it is stopped. Late calls are skipped, never caught up in a burst.

    Args:
        period: Time between two calls [s].
        call: The function.
        clock: Host time [s].
        stopped: Ends the loop when set.
        on_grid: After a late call, wait for the next multiple of the period. Otherwise call again at once and count the
            next period from there.

    Attributes:
        statistics: How well deadlines are met.
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
            # Waiting for an event is as precise as sleeping, and ends at once when the event is set.
            if self._stopped.wait(max(0.0, due - self._clock())):
                return
            self.statistics.add_tick(due, self._clock(), missed)
            self._call()
            now = self._clock()
            missed = max(0, int((now - due) / period))
            due = due + (1 + missed) * period if self._on_grid else max(due + period, now)


class LoopThreads:
    """Runs each loop in its own thread, and makes all threads of the process release the interpreter often.

    Args:
        loops: Loops by name.
        stopped: The event that ends these loops.
    """

    def __init__(self, loops: Mapping[str, PeriodicLoop], stopped: threading.Event) -> None:
        self._loops = loops
        self._stopped = stopped
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start the threads.

        Raises:
            RuntimeError: They were started before.
        """
        if self._threads:
            raise RuntimeError("the threads were already started.")
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL)
        for name, loop in self._loops.items():
            thread = threading.Thread(target=loop.run, name=f"aero-planner-{name}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def close(self) -> bool:
        """End the loops and wait up to 2 s for each thread; return True if every thread has ended."""
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        if self._threads:
            sys.setswitchinterval(self._switch_interval)
        return not any(thread.is_alive() for thread in self._threads)


def run_step(step: Callable[[], Any], name: str) -> bool:
    """Run one step of a thread and log its exception; return True if there was none."""
    try:
        step()
    except Exception:
        _log.exception("%s failed", name)
        return False
    return True
