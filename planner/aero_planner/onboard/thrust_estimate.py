"""The gain of the vehicle's thrust over what its hover thrust implies, estimated in flight."""

from __future__ import annotations

import logging

import numpy as np

from aero_planner.config import VehicleConfig
from aero_planner.onboard.dead_reckoning import MotionState, compared_interval
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import ThrustSettings
from aero_planner.onboard.thrust import ThrustModel
from aero_planner.quaternions import rotate

_log = logging.getLogger(__name__)

_TIME_CONSTANT = 2.0
"""Time in which an error of the gain falls to a third [s]."""
_LARGEST = 1.5
"""Largest gain; the smallest is its inverse."""
_MAX_ERROR = 0.5
"""Largest relative error of a measurement that is accepted."""
_MIN_UPRIGHT = 0.8
"""Smallest vertical share of the thrust with which it is measured: the drag of a tilted vehicle is horizontal."""
_MIN_THRUST = 0.3
"""Smallest thrust with which it is measured, as a fraction of the weight."""
_NOTABLE = 0.1
"""Change of the gain that is logged."""


class ThrustEstimate:
    """Estimates the gain from the measured and the predicted vertical acceleration.

    Args:
        vehicle: Mass and gravity.
        settings: The hover thrust and the thrust curve, for the log, and whether anything is corrected at all.

    Attributes:
        gain: True thrust divided by the commanded one; 1 before it is known.
    """

    def __init__(self, vehicle: VehicleConfig, settings: ThrustSettings) -> None:
        self.gain = 1.0
        self._vehicle, self._settings = vehicle, settings
        self._model = ThrustModel(vehicle.mass, vehicle.gravity, settings.hover_thrust, settings.curve)
        self._logged = 1.0

    def update(self, previous: VehicleSample, predicted: MotionState | None, sample: VehicleSample) -> None:
        """Compare a state with what was predicted for its time from the previous one; see `compared_interval`."""
        interval = compared_interval(previous, predicted, sample)
        if not self._settings.adapt or interval is None or predicted is None or predicted.control is None:
            return
        lift = float(predicted.control[0]) / self._vehicle.mass
        upright = float(rotate(predicted.quaternion, [0.0, 0.0, 1.0])[2])
        if upright < _MIN_UPRIGHT or lift < _MIN_THRUST * self._vehicle.gravity:
            return
        measured = float(np.asarray(sample.state.velocity)[2] - predicted.velocity[2]) / interval
        error = min(max(measured / (lift * upright), -_MAX_ERROR), _MAX_ERROR)
        gain = self.gain * (1.0 + error * interval / _TIME_CONSTANT)
        self.gain = min(max(gain, 1.0 / _LARGEST), _LARGEST)
        if abs(self.gain - self._logged) > _NOTABLE:
            self._logged = self.gain
            hover_thrust = self._model.signal(self._vehicle.mass * self._vehicle.gravity / self.gain)
            _log.warning(
                "the thrust is %.2f times what thrust.hover_thrust says, which is corrected in flight; set it to %.3f",
                self.gain, hover_thrust,
            )  # fmt: skip
