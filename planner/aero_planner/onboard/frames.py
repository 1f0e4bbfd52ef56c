"""MAVLink's frames and ours: north-east-down and forward-right-down to north-west-up and forward-left-up, and back.

The world frame is the autopilot's local frame turned by half a turn about its x axis (north), the body frame the
autopilot's body frame turned by half a turn about its x axis (forward). A half turn undoes itself, so that each
conversion is its own inverse; both names exist so that a call says which way it goes.

Arrays are float64. Quaternions are w, x, y, z and turn body vectors into the world (or local) frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "advance",
    "attitude_from_ned",
    "attitude_to_ned",
    "flu_from_frd",
    "frd_from_flu",
    "multiply",
    "ned_from_world",
    "quaternion_from_angles",
    "rotate",
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


def multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the quaternion product a b [.., 4]: b is applied first."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    aw, ax, ay, az = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    bw, bx, by, bz = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    result = np.empty((*np.broadcast_shapes(p.shape[:-1], q.shape[:-1]), 4))
    result[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    result[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    result[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    result[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return result


def rotate(quaternion: ArrayLike, vector: ArrayLike) -> Array:
    """Return vectors [.., 3] turned by unit quaternions [.., 4]: v + w t + u x t with t = 2 u x v, q = (w, u)."""
    q, v = np.asarray(quaternion, dtype=np.float64), np.asarray(vector, dtype=np.float64)
    # Written out: np.cross takes five times as long for a single vector.
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    a, b, c = v[..., 0], v[..., 1], v[..., 2]
    ta, tb, tc = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    result = np.empty((*np.broadcast_shapes(q.shape[:-1], v.shape[:-1]), 3))
    result[..., 0] = a + w * ta + (y * tc - z * tb)
    result[..., 1] = b + w * tb + (z * ta - x * tc)
    result[..., 2] = c + w * tc + (x * tb - y * ta)
    return result


def advance(quaternion: ArrayLike, rates: ArrayLike, time: float) -> Array:
    """Return the attitude [4] after turning with constant body rates [3] [rad/s] for `time` [s], which may be < 0."""
    rates = np.asarray(rates, dtype=np.float64)
    speed = float(np.linalg.norm(rates))
    half = 0.5 * speed * time
    axis = rates / speed if speed > 0.0 else np.zeros(3)
    return multiply(quaternion, [math.cos(half), *(math.sin(half) * axis)])


def quaternion_from_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Return the quaternion [4] of R = R_z(yaw) R_y(pitch) R_x(roll), angles in degrees, as a sensor is mounted."""
    half = [0.5 * math.radians(angle) for angle in (roll, pitch, yaw)]
    x, y, z = ([math.cos(a), *(math.sin(a) * axis)] for a, axis in zip(half, np.eye(3), strict=True))
    return multiply(z, multiply(y, x))
