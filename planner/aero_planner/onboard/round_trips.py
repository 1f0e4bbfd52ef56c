"""Round trips to the autopilot, by TIMESYNC: how late the link is, also if it has been late since the start."""

from __future__ import annotations

import math
import statistics
from collections import deque

_PERIOD = 0.1
"""Time between two requests [s]."""
_WAITING_MAX = 100
"""Requests that may be answered; older ones are forgotten."""
_MIN_ANSWERS = 3
_MEMORY = 10.0
"""Time for which the shortest round trip tells about the autopilot's clock [s]."""
_ORDINARY = 0.04
"""Round trip of a link that is not late [s]: two periods of the control loop, which sends and reads."""


class RoundTrips:
    """Sends the host time to the autopilot, which returns it with its own.

    The offset between the clocks lies between those at both ends of a round trip. Time stamps alone can't tell a link
    that is always late from a good one.

    Args:
        window: Time over which the median of the round trips is taken [s].
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._requested = -math.inf
        self._waiting: deque[int] = deque(maxlen=_WAITING_MAX)
        self._answers: deque[tuple[float, float, float]] = deque()
        """Time of arrival, duration, and offset of the clocks in the middle [s]."""

    def request(self, now: float) -> int | None:
        """Return the host time [ns] of a request that is due at `now` [s], or None."""
        if now - self._requested < _PERIOD:
            return None
        self._requested = now
        self._waiting.append(round(1e9 * now))
        return self._waiting[-1]

    def answer(self, stamp: int, requested: int, now: float) -> bool:
        """Add an answer that arrives at `now` [s]; return False if nothing was asked.

        Args:
            stamp: Time by the autopilot's clock [ns].
            requested: Host time of the request [ns].
        """
        if stamp <= 0 or requested not in self._waiting:
            return False
        self._waiting.remove(requested)
        sent = 1e-9 * requested
        offset = 0.5 * (sent + now) - 1e-9 * stamp
        if self._answers and abs(offset - self._answers[-1][2]) > 1.0:
            self._answers.clear()  # the autopilot's clock was set
        self._answers.append((now, now - sent, offset))
        while self._answers[0][0] < now - _MEMORY:
            self._answers.popleft()
        return True

    def median(self, now: float) -> float:
        """Return the median of the newest round trips [s]; NaN if there are too few."""
        newest = [duration for time, duration, _ in self._answers if time >= now - self._window]
        return statistics.median(newest) if len(newest) >= _MIN_ANSWERS else math.nan

    def max_offset(self, now: float) -> float:
        """Return the largest offset of the autopilot's clock that a late link hides [s]; infinite if it is unknown.

        That of an ordinary link is larger than the smallest difference between stamps and arrivals.
        """
        known = [(duration, offset) for time, duration, offset in self._answers if time >= now - _MEMORY]
        return min(known)[1] + 0.5 * _ORDINARY if known else math.inf
