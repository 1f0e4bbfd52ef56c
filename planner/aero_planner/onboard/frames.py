"""MAVLink's frames and ours: north-east-down and forward-right-down to north-west-up and forward-left-up, and back.

The world frame is the autopilot's local frame turned by half a turn about its x axis (north), the body frame the
autopilot's body frame turned by half a turn about its x axis (forward). A half turn undoes itself, so that each
conversion is its own inverse; both names exist so that a call says which way it goes.

Arrays are float64. Quaternions are w, x, y, z and turn body vectors into the world (or local) frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "attitude_from_ned",
    "attitude_to_ned",
    "flu_from_frd",
    "frd_from_flu",
    "ned_from_world",
    "world_from_ned",
]

Array = NDArray[np.float64]

_HALF_TURN = np.array([1.0, -1.0, -1.0])
_HALF_TURN_QUATERNION = np.array([1.0, 1.0, -1.0, -1.0])


def world_from_ned(vector: ArrayLike) -> Array:
    """Return position, velocity or acceleration [.., 3] north-east-down as north-west-up."""
    return np.asarray(vector, dtype=np.float64) * _HALF_TURN


def ned_from_world(vector: ArrayLike) -> Array:
    """Return position, velocity or acceleration [.., 3] north-west-up as north-east-down."""
    return world_from_ned(vector)


def flu_from_frd(vector: ArrayLike) -> Array:
    """Return body rates or body vectors [.., 3] forward-right-down as forward-left-up."""
    return world_from_ned(vector)


def frd_from_flu(vector: ArrayLike) -> Array:
    """Return body rates or body vectors [.., 3] forward-left-up as forward-right-down."""
    return world_from_ned(vector)


def attitude_from_ned(quaternion: ArrayLike) -> Array:
    """Return an attitude [.., 4], body forward-right-down to north-east-down, as body forward-left-up to world.

    With h the half turn about x, q' = h q h^-1, which turns the signs of y and z.
    """
    return np.asarray(quaternion, dtype=np.float64) * _HALF_TURN_QUATERNION


def attitude_to_ned(quaternion: ArrayLike) -> Array:
    """Return an attitude [.., 4], body forward-left-up to world, as body forward-right-down to north-east-down."""
    return attitude_from_ned(quaternion)
