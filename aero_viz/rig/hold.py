"""Model of PX4's HOLD: it brakes the vehicle and then holds its position."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.quaternions import conjugate, rotate

_ACCELERATION_MAX = 2.0
"""Largest acceleration that HOLD asks for [m/s^2]; PX4 limits the jerk as well."""
_SPEED_TO_HOLD = 0.5
"""Speed below which the present position becomes the one to hold [m/s]."""
_VELOCITY_GAIN, _POSITION_GAIN, _ATTITUDE_GAIN = 2.5, 2.0, 8.0
"""[1/s], [1/s^2], [1/s]"""


class HoldControl:
    """Cascade of controllers: the position error gives an acceleration, which gives an attitude, which gives rates.

    Args:
        mass: mass of the vehicle [kg].
        gravity: gravity [m/s^2].
        position: position to hold at first [m], shape [3], world frame.

    Attributes:
        position: position that is held [m], shape [3], world frame; None while the vehicle brakes.
    """

    def __init__(self, mass: float, gravity: float, position: ArrayLike) -> None:
        self.position: NDArray[np.float64] | None = np.array(position, dtype=np.float64)
        self._mass, self._gravity = mass, gravity

    def engage(self) -> None:
        """Begin by braking."""
        self.position = None

    def control(
        self, position: NDArray[np.float64], velocity: NDArray[np.float64], quaternion: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return thrust [N] and body rates [rad/s], shape [4].

        Args:
            position: position [m], shape [3], world frame.
            velocity: velocity [m/s], shape [3], world frame.
            quaternion: attitude, body to world, w x y z, shape [4].
        """
        up = np.array([0.0, 0.0, 1.0])
        if self.position is None and np.linalg.norm(velocity) < _SPEED_TO_HOLD:
            self.position = position
        acceleration = -_VELOCITY_GAIN * velocity
        if self.position is not None:
            acceleration = acceleration - _POSITION_GAIN * (position - self.position)
        acceleration *= min(1.0, _ACCELERATION_MAX / max(float(np.linalg.norm(acceleration)), 1e-9))
        force = self._mass * (acceleration + self._gravity * up)
        thrust_axis = rotate(quaternion, up)
        attitude_error = np.cross(thrust_axis, force / np.linalg.norm(force))
        rates = _ATTITUDE_GAIN * rotate(conjugate(quaternion), attitude_error)
        return np.array([force @ thrust_axis, rates[0], rates[1], 0.0])
