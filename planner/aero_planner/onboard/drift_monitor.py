"""Drift of the estimate during the last seconds, as measured by the LiDAR."""

from __future__ import annotations

import math
from collections import deque

from aero_planner.onboard.cloud_drift import Drift

_WINDOW = 3.0  # [s]
_MIN_MEASUREMENTS = 3


class DriftMonitor:
    """Root mean squares of the drift over the last three seconds; NaN while too little was measured.

    Attributes:
        angle: Error of the attitude [rad].
        speed: Error of the velocity [m/s].
    """

    def __init__(self) -> None:
        self.angle = self.speed = math.nan
        self._measured: deque[tuple[float, float, float]] = deque()

    def add(self, time: float, drift: Drift, interval: float) -> None:
        """Add a drift that was measured at `time` [s] over an interval [s]."""
        self._measured.append((time, drift.angle, drift.shift / interval))

    def update(self, now: float) -> None:
        """Forget measurements from too long before `now` [s]."""
        while self._measured and self._measured[0][0] < now - _WINDOW:
            self._measured.popleft()
        count = len(self._measured)
        self.angle, self.speed = (
            math.sqrt(sum(values[k] ** 2 for values in self._measured) / count)
            if count >= _MIN_MEASUREMENTS
            else math.nan
            for k in (1, 2)
        )
