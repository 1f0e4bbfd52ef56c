"""Unit quaternions and rigid transforms in NumPy, for single values and for arrays.

A quaternion is w, x, y, z and rotates body vectors into the world frame. Every function takes any leading shape,
broadcasts as NumPy does, and computes in float64. Components are written out, and those of a single value are numbers
of Python: NumPy takes several times as long for them, and these functions run in the control loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_SMALLEST_SINE = 1e-6
"""For a smaller angle the arc is its chord, and the quotients of `slerp` would be 0 / 0."""


def multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the Hamilton product a b, shape [.., 4]: the rotation b followed by the rotation a."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    (aw, ax, ay, az), (bw, bx, by, bz) = _components(p), _components(q)
    product = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return _joined(product, p, q)


def conjugate(quaternion: ArrayLike) -> Array:
    """Return the conjugate, shape [.., 4]: the inverse rotation of a unit quaternion."""
    return np.asarray(quaternion, dtype=np.float64) * _CONJUGATE


def rotate(quaternion: ArrayLike, vector: ArrayLike) -> Array:
    """Return the vectors [.., 3] rotated by the unit quaternions [.., 4].

    With q = (w, u): R(q) v = v + w t + u x t, where t = 2 u x v.
    """
    q, v = np.asarray(quaternion, dtype=np.float64), np.asarray(vector, dtype=np.float64)
    (w, x, y, z), (a, b, c) = _components(q), _components(v)
    ta, tb, tc = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    turned = (a + w * ta + (y * tc - z * tb), b + w * tb + (z * ta - x * tc), c + w * tc + (x * tb - y * ta))
    return _joined(turned, q, v)


def rotation_matrix(quaternion: ArrayLike) -> Array:
    """Return R(q), shape [.., 3, 3], of unit quaternions [.., 4]."""
    q = np.asarray(quaternion, dtype=np.float64)
    result = np.empty((*q.shape[:-1], 3, 3))
    for column, axis in enumerate(np.eye(3)):
        result[..., column] = rotate(q, axis)
    return result


def rotation_vector(quaternion: ArrayLike) -> Array:
    """Return axis times angle [.., 3] [rad] of unit quaternions [.., 4]; the angle is at most pi."""
    q = np.asarray(quaternion, dtype=np.float64)
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)


def slerp(a: ArrayLike, b: ArrayLike, fraction: ArrayLike) -> Array:
    """Return the attitudes [.., 4] at `fraction` [..] in [0, 1] of the shortest rotation from a to b, each [.., 4]."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    f = np.asarray(fraction, dtype=np.float64)[..., None]
    dot = np.sum(p * q, axis=-1, keepdims=True)
    q, dot = np.where(dot < 0, -q, q), np.abs(dot)
    angle = np.arccos(np.clip(dot, 0.0, 1.0))
    sine = np.sin(angle)
    small = sine < _SMALLEST_SINE
    divisor = np.where(small, 1.0, sine)
    result = np.where(small, 1.0 - f, np.sin((1.0 - f) * angle) / divisor) * p
    result = result + np.where(small, f, np.sin(f * angle) / divisor) * q
    return result / np.linalg.norm(result, axis=-1, keepdims=True)


def integrate_rates(quaternion: ArrayLike, rates: ArrayLike, time: float) -> Array:
    """Return the attitude [4] after turning at constant body rates [3] [rad/s] for `time` [s], possibly negative."""
    rates = np.asarray(rates, dtype=np.float64)
    speed = math.sqrt(rates.dot(rates))
    half = 0.5 * speed * time
    axis = rates / speed if speed > 0.0 else np.zeros(3)
    return multiply(quaternion, [math.cos(half), *(math.sin(half) * axis)])


def quaternion_from_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Return the quaternion [4] of R_z(yaw) R_y(pitch) R_x(roll), with the angles in degrees."""
    half = [0.5 * math.radians(angle) for angle in (roll, pitch, yaw)]
    x, y, z = ([math.cos(a), *(math.sin(a) * axis)] for a, axis in zip(half, np.eye(3), strict=True))
    return multiply(z, multiply(y, x))


def quaternion_of_matrix(matrix: ArrayLike) -> Array:
    """Return the unit quaternions [.., 4] of rotation matrices [.., 3, 3], with w >= 0."""
    m = np.asarray(matrix, dtype=np.float64)
    r = {(i, j): m[..., i, j] for i in range(3) for j in range(3)}
    # Four times the products of the components; the row with the largest diagonal has the smallest rounding error.
    ww, xx = 1.0 + r[0, 0] + r[1, 1] + r[2, 2], 1.0 + r[0, 0] - r[1, 1] - r[2, 2]
    yy, zz = 1.0 - r[0, 0] + r[1, 1] - r[2, 2], 1.0 - r[0, 0] - r[1, 1] + r[2, 2]
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    rows = np.stack([ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz], axis=-1)
    rows = rows.reshape(*m.shape[:-2], 4, 4)
    best = np.argmax(np.stack([ww, xx, yy, zz], axis=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = np.where(q[..., :1] < 0.0, -q, q)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def compose_transforms(
    position_a: ArrayLike, quaternion_a: ArrayLike, position_b: ArrayLike, quaternion_b: ArrayLike
) -> tuple[Array, Array]:
    """Return the transform b followed by the transform a: x -> R(q_a) (R(q_b) x + p_b) + p_a.

    Positions have shape [.., 3] [m], quaternions [.., 4].
    """
    return rotate(quaternion_a, position_b) + np.asarray(position_a, dtype=np.float64), multiply(
        quaternion_a, quaternion_b
    )


def invert_transform(position: ArrayLike, quaternion: ArrayLike) -> tuple[Array, Array]:
    """Return position [.., 3] and quaternion [.., 4] of the inverse of x -> R(q) x + p."""
    inverse = conjugate(quaternion)
    return -rotate(inverse, position), inverse


def _components(value: Array) -> Sequence[Any]:
    """Return the components of the last axis: numbers for a single value, which Python handles faster than NumPy."""
    return value.tolist() if value.ndim == 1 else [value[..., k] for k in range(value.shape[-1])]


def _joined(components: Sequence[Any], a: Array, b: Array) -> Array:
    """Return an array of components that were computed from `a` and `b`."""
    if a.ndim == b.ndim == 1:
        return np.array(components)
    result = np.empty((*np.broadcast_shapes(a.shape[:-1], b.shape[:-1]), len(components)))
    for k, component in enumerate(components):
        result[..., k] = component
    return result
