"""The controller that stops and levels the drone where no plan is flown."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.settings import BrakeSettings
from aero_planner.quaternions import conjugate, rotate

__all__ = ["StopController"]

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_MIN_LIFT = 0.3
"""Smallest vertical force while braking, as a fraction of the weight: a drone that climbs fast must not turn over."""
_LEVELLING_TIME = 3.0
"""Time for levelling, in time constants of the attitude: 1.5 deg remain of a tilt of 30 deg."""


class StopController:
    """Stops the drone, level, and holds its position, by thrust and body rates.

    The desired acceleration is -v / tau + k (p_hold - p), bounded. The thrust vector turns to its direction at a rate
    proportional to the angle between the two. The heading is not controlled.

    Args:
        vehicle: Mass, gravity and control bounds.
        settings: See `BrakeSettings`.
    """

    def __init__(self, vehicle: VehicleConfig, settings: BrakeSettings) -> None:
        self._vehicle = vehicle
        self._settings = settings

    @property
    def hover(self) -> Array:
        """Command of a level drone at rest: thrust [N] and body rates [rad/s], shape [4]."""
        return np.array([self._vehicle.mass * self._vehicle.gravity, 0.0, 0.0, 0.0])

    def command(self, motion: MotionState, *, hold: Array | None = None, remaining: float = math.inf) -> Array:
        """Return thrust F_t [N] and body rates omega [rad/s], shape [4], within the vehicle's bounds.

        Args:
            motion: Present motion.
            hold: Position to hold [m], shape [3], world frame; None only brakes.
            remaining: Time until the last command [s], which is `hover` and keeps the tilt. The end of this time is
                used to level the drone, at whatever speed it has then.
        """
        vehicle = self._vehicle
        desired = self._desired_acceleration(motion, hold, remaining)
        force = vehicle.mass * (desired + vehicle.gravity * _UP)
        force[2] = max(force[2], _MIN_LIFT * vehicle.mass * vehicle.gravity)
        up = rotate(motion.quaternion, _UP)
        direction = force / np.linalg.norm(force)
        axis = np.cross(up, direction)
        sine, cosine = float(np.linalg.norm(axis)), float(up @ direction)
        # Upside down, any axis will do.
        axis = axis / sine if sine > 1e-9 else rotate(motion.quaternion, np.array([1.0, 0.0, 0.0]))
        turn_rate = self._settings.attitude_gain * math.atan2(sine, cosine)
        rates = rotate(conjugate(motion.quaternion), turn_rate * axis)
        limit = vehicle.rate_xy_max
        return np.array(
            [
                min(max(float(force @ up), vehicle.thrust_min), vehicle.thrust_max),
                min(max(rates[0], -limit), limit),
                min(max(rates[1], -limit), limit),
                0.0,
            ]
        )

    def _desired_acceleration(self, motion: MotionState, hold: Array | None, remaining: float) -> Array:
        """Return the bounded acceleration [m/s^2], shape [3], world frame."""
        settings = self._settings
        if remaining <= _LEVELLING_TIME / settings.attitude_gain:
            return np.zeros(3)
        desired = -motion.velocity / settings.time_constant
        if hold is not None:
            desired = desired + settings.position_gain * (hold - motion.position)
        size = float(np.linalg.norm(desired))
        return desired * (settings.acceleration / size) if size > settings.acceleration else desired
