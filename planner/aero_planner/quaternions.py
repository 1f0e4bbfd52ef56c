"""Unit quaternions w, x, y, z, body to world, as float64 arrays of any leading shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["advance", "multiply", "quaternion_from_angles", "rotate"]

Array = NDArray[np.float64]


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
