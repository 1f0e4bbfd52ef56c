"""Unit quaternions w, x, y, z, body to world, in arrays of any leading shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["compose", "inverse", "matrices", "multiply", "rotate", "slerp"]

Array = NDArray[np.float64]


def multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product a (x) b, shape [..., 4]."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate(q: Array, v: Array) -> Array:
    """Return R(q) v, shape [..., 3]."""
    q, v = np.asarray(q), np.asarray(v)
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def matrices(q: Array) -> Array:
    """Return R(q), shape [..., 3, 3]."""
    return np.stack([rotate(q, axis) for axis in np.eye(3)], axis=-1)


def slerp(a: Array, b: Array, fraction: Array) -> Array:
    """Return the shortest rotation from a to b at `fraction` in [0, 1], shape [n, 4]."""
    dot = np.sum(a * b, axis=-1, keepdims=True)
    b, dot = np.where(dot < 0, -b, b), np.abs(dot)
    angle = np.arccos(np.clip(dot, 0.0, 1.0))
    sine = np.sin(angle)
    f = np.asarray(fraction)[..., None]
    # Below this angle the arc is its chord, and the quotients would be 0 / 0.
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    out = np.where(near, 1.0 - f, np.sin((1.0 - f) * angle) / safe) * a
    out = out + np.where(near, f, np.sin(f * angle) / safe) * b
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def compose(p: Array, q: Array, p2: Array, q2: Array) -> tuple[Array, Array]:
    """Return the transform (p, q) after (p2, q2): x -> R(q) (R(q2) x + p2) + p."""
    return rotate(q, p2) + p, multiply(q, q2)


def inverse(p: Array, q: Array) -> tuple[Array, Array]:
    """Return the inverse transform of (p, q)."""
    conjugate = np.asarray(q) * np.array([1.0, -1.0, -1.0, -1.0])
    return -rotate(conjugate, p), conjugate
