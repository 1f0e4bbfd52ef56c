"""Acceleration that the commands do not explain, such as that of gusts, estimated in flight."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.dead_reckoning import MotionState, compared_interval
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import ResponseSettings

_TIME_CONSTANT = 0.4
"""Time over which the acceleration is averaged [s]: the velocities of states are noisy, and gusts last longer."""


class DisturbanceEstimate:
    """Averages the differences of successive velocities from those that were predicted from the commands.

    Args:
        response: Drag of the vehicle, which the predictions contain.

    Attributes:
        acceleration: Acceleration besides thrust and gravity [m/s^2], shape [3], world frame; 0 before it is known.
    """

    def __init__(self, response: ResponseSettings) -> None:
        self.acceleration: NDArray[np.float64] = np.zeros(3)
        self._drag = response.drag

    def update(self, previous: VehicleSample, predicted: MotionState | None, sample: VehicleSample) -> None:
        """Compare a state with what was predicted for its time from the previous one; see `compared_interval`."""
        interval = compared_interval(previous, predicted, sample)
        if interval is None or predicted is None:
            self.acceleration = np.zeros(3)
            return
        velocity = np.asarray(sample.state.velocity, dtype=np.float64)
        unexplained = (velocity - predicted.velocity) / interval - self._drag * velocity
        share = 1.0 - math.exp(-interval / _TIME_CONSTANT)
        self.acceleration = self.acceleration + share * (unexplained - self.acceleration)
