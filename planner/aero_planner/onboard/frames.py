"""Conversions between MAVLink's coordinate frames (NED, FRD) and the planner's (north-west-up, forward-left-up).

The world frame is the autopilot's local frame after half a turn about its x axis (north). The body frame is the
autopilot's body frame after half a turn about its x axis (forward). Half a turn is its own inverse, and so is each
conversion; both directions have a name so that a call states which one it means.

Arrays are float64. Quaternions are w, x, y, z and rotate body vectors into the world (or local) frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_HALF_TURN = np.array([1.0, -1.0, -1.0])
_HALF_TURN_QUATERNION = np.array([1.0, 1.0, -1.0, -1.0])


def world_from_ned(vector: ArrayLike) -> Array:
    """Convert a position, velocity or acceleration [.., 3] from north-east-down to north-west-up."""
    return np.asarray(vector, dtype=np.float64) * _HALF_TURN


def ned_from_world(vector: ArrayLike) -> Array:
    """Convert a position, velocity or acceleration [.., 3] from north-west-up to north-east-down."""
    return world_from_ned(vector)


def flu_from_frd(vector: ArrayLike) -> Array:
    """Convert body rates or body vectors [.., 3] from forward-right-down to forward-left-up."""
    return world_from_ned(vector)


def frd_from_flu(vector: ArrayLike) -> Array:
    """Convert body rates or body vectors [.., 3] from forward-left-up to forward-right-down."""
    return world_from_ned(vector)


def attitude_from_ned(quaternion: ArrayLike) -> Array:
    """Convert an attitude [.., 4] from FRD body to NED into forward-left-up body to world.

    With h the half turn about x, q' = h q h^-1, which flips the signs of y and z.
    """
    return np.asarray(quaternion, dtype=np.float64) * _HALF_TURN_QUATERNION


def attitude_to_ned(quaternion: ArrayLike) -> Array:
    """Convert an attitude [.., 4] from forward-left-up body to world into FRD body to NED."""
    return attitude_from_ned(quaternion)
