"""Drift of the estimate during the last moments, as measured by the LiDAR."""

from __future__ import annotations

import math
import statistics
from collections import deque

from aero_planner.onboard.cloud_drift import Drift

_MEMORY = 3.0
"""Time after which a measurement no longer counts, even if there is no newer one [s]."""
_MIN_MEASUREMENTS = 3


class DriftMonitor:
    """Medians of the newest measurements of the drift; NaN while there are too few.

    A single measurement may be wrong, where obstacles move that are mistaken for a world that does.

    Args:
        window: Time before the newest measurement in which measurements count [s].

    Attributes:
        angle: Error of the attitude [rad].
        speed: Error of the velocity [m/s].
    """

    def __init__(self, window: float) -> None:
        self.angle = self.speed = math.nan
        self._window = window
        self._measured: deque[tuple[float, float, float]] = deque()

    def add(self, time: float, drift: Drift, interval: float) -> None:
        """Add a drift that was measured at `time` [s] over an interval [s]."""
        self._measured.append((time, drift.angle, drift.shift / interval))
        while self._measured[0][0] < time - self._window:
            self._measured.popleft()

    def update(self, now: float) -> None:
        """Forget measurements from too long before `now` [s]."""
        while self._measured and self._measured[0][0] < now - _MEMORY:
            self._measured.popleft()
        self.angle, self.speed = (
            statistics.median(values[k] for values in self._measured)
            if len(self._measured) >= _MIN_MEASUREMENTS
            else math.nan
            for k in (1, 2)
        )
