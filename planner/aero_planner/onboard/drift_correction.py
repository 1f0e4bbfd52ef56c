"""Correction of a motion whose position is lost, by the drift that the LiDAR measures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.cloud_drift import Drift
from aero_planner.onboard.dead_reckoning import MotionState

# The height is not lost with the position: the autopilot has a barometer, and a LiDAR sees little that tells it.
_HORIZONTAL = np.array([1.0, 1.0, 0.0])
_MEMORY = 2.0
"""Time after which the last measurement no longer counts [s]."""


class DriftCorrection:
    """Removes the horizontal drift of the estimate from a motion while the position is lost.

    An estimator without a position drifts, so a drone that it believes to be at rest moves. The LiDAR sees this motion.
    The correction starts from zero each time the position is lost.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all measurements, because the origin of the world frame has moved."""
        self._newest: NDArray[np.float64] = np.zeros(3)  # newest measurement [m/s]
        self._velocity: NDArray[np.float64] = np.zeros(3)
        self._displacement: NDArray[np.float64] = np.zeros(3)
        self._measured = -math.inf
        self._last: float | None = None  # time of the last corrected motion

    def add(self, time: float, drift: Drift, interval: float) -> None:
        """Add a drift that was measured at `time` [s] over an interval [s].

        A single measurement may be wrong by 0.1 m/s. Of two in a row, the smaller one counts along each axis, and none
        if their signs differ.
        """
        velocity = drift.displacement / interval * _HORIZONTAL
        before = self._newest if time - self._measured <= _MEMORY else np.zeros(3)
        agreed = np.sign(velocity) * np.minimum(np.abs(velocity), np.abs(before))
        self._velocity = np.where(velocity * before > 0.0, agreed, 0.0)
        self._newest, self._measured = velocity, time

    def apply(self, motion: MotionState, *, lost: bool) -> MotionState:
        """Return the motion without the drift since the position was lost, or as it is while it is not lost.

        The velocity is corrected by the measured drift, and the position by its integral.
        """
        if not lost:
            self._last = None
            return motion
        if self._last is None:
            self.clear()
            self._last = motion.time
        if motion.time - self._measured > _MEMORY:
            self._velocity = np.zeros(3)
        self._displacement = self._displacement + (motion.time - self._last) * self._velocity
        self._last = motion.time
        return replace(motion, position=motion.position - self._displacement, velocity=motion.velocity - self._velocity)
