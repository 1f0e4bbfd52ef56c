"""The ground height in the autopilot's local frame, whose own height may be wrong by a metre."""

from __future__ import annotations

import enum
import logging
import math
from collections import deque

import numpy as np

from aero_planner.onboard.interfaces import VehicleSample

_log = logging.getLogger(__name__)

_WINDOW = 5.0  # [s] of measurements that count
_MIN_MEASUREMENTS = {"range": 5, "cloud": 2}
_QUANTILE = 0.25  # of the measurements, so that a bush below the drone does not count as ground
_LOGGED_CHANGE = 0.3  # [m]


class GroundSource(enum.Enum):
    """Source of the height of the ground."""

    RANGE = "measured by the autopilot's distance sensor"
    CLOUD = "measured by the LiDAR"
    STANDING = "where the drone stood before the flight"
    ASSUMED = "assumed at the local origin"


class GroundTracker:
    """The ground height from the best source so far: distance sensor, LiDAR, or the place where the drone stood.

    A measured height stays in force until the same or a better source measures another one.

    Attributes:
        height: Height of the ground, world frame [m].
        source: How it was found.
    """

    def __init__(self) -> None:
        self.clear()

    @property
    def known_height(self) -> float | None:
        """Height of the ground, world frame [m]; None while it is only assumed."""
        return None if self.source is GroundSource.ASSUMED else self.height

    def clear(self) -> None:
        """Forget everything, because the origin of the world frame has moved."""
        self.height = 0.0
        self.source = GroundSource.ASSUMED
        self._logged = math.nan
        self._measurements: dict[str, deque[tuple[float, float]]] = {name: deque() for name in _MIN_MEASUREMENTS}

    def add_sample(self, sample: VehicleSample, previous: VehicleSample | None = None) -> None:
        """Add what a sample of the vehicle tells: where it stands, or a range that `previous` does not have yet."""
        if sample.in_air is False and not sample.armed:
            self.add_standing(float(np.asarray(sample.state.position)[2]))
        elif previous is None or sample.ground_height != previous.ground_height:
            self.add_range(sample.time, sample.ground_height)

    def add_standing(self, height: float) -> None:
        """Add the height of a drone that stands on the ground, disarmed [m]."""
        self.height, self.source = height, GroundSource.STANDING
        for measurements in self._measurements.values():
            measurements.clear()

    def add_range(self, time: float, height: float) -> None:
        """Add a height of the ground that a distance sensor measured at `time` [s]."""
        self._add("range", GroundSource.RANGE, time, height)

    def add_cloud(self, time: float, height: float) -> None:
        """Add a height of the ground that was seen in the LiDAR's cloud at `time` [s]."""
        measured_by_range = self._measurements["range"]
        if not measured_by_range or time - measured_by_range[-1][0] > _WINDOW:
            self._add("cloud", GroundSource.CLOUD, time, height)

    def _add(self, name: str, source: GroundSource, time: float, height: float) -> None:
        if not math.isfinite(height):
            return
        measurements = self._measurements[name]
        measurements.append((time, height))
        while measurements[0][0] < time - _WINDOW:
            measurements.popleft()
        if len(measurements) < _MIN_MEASUREMENTS[name]:
            return
        self.height, self.source = float(np.quantile([value for _, value in measurements], _QUANTILE)), source
        if not abs(self.height - self._logged) <= _LOGGED_CHANGE:
            self._logged = self.height
            _log.info("the ground is at a height of %.2f m, %s", self.height, source.value)
