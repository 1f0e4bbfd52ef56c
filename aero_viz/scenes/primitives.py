"""Tables of cylinders, boxes and spheres: bounds and exact distances in double precision.

Rows are those of `World`: cylinders [n, 8], boxes [n, 7], spheres [n, 4], in metres and radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def primitive_bounds(
    cylinders: NDArray[np.float64], boxes: NDArray[np.float64], spheres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corners [m] of the axis-aligned box around each primitive, both [n, 3].

    The rows are those of the cylinders, then the boxes, then the spheres.
    """
    base, axis, radius, height = np.split(cylinders, [3, 6, 7], axis=1)
    tip = base + height * axis
    rim = radius * np.sqrt(np.clip(1.0 - axis**2, 0.0, 1.0))  # half extent of a disc whose normal is the axis
    c, s = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    hx, hy, hz = 0.5 * boxes[:, 3:6].T
    half = np.stack([c * hx + s * hy, s * hx + c * hy, hz], axis=1)
    lower = [np.minimum(base, tip) - rim, boxes[:, :3] - half, spheres[:, :3] - spheres[:, 3:]]
    upper = [np.maximum(base, tip) + rim, boxes[:, :3] + half, spheres[:, :3] + spheres[:, 3:]]
    return np.vstack(lower), np.vstack(upper)


def rotate_z(vectors: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors [.., 3] rotated about z by angles [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _solid_distance(excess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the signed distance to a solid from how far a point exceeds each half extent, last axis [m].

    Outside, this is the norm of the positive excesses; inside, the largest (least negative) excess.
    """
    outside = np.sqrt(np.sum(np.maximum(excess, 0.0) ** 2, axis=-1))
    return outside + np.minimum(excess.max(axis=-1), 0.0)


def _cylinder_distance(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    relative = points - table[:, :3]
    along = np.sum(relative * table[:, 3:6], axis=-1)
    across = np.linalg.norm(relative - along[..., None] * table[:, 3:6], axis=-1)
    half = 0.5 * table[:, 7]
    return _solid_distance(np.stack([across - table[:, 6], np.abs(along - half) - half], axis=-1))


def _box_distance(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    return _solid_distance(np.abs(rotate_z(points - table[:, :3], -table[:, 6])) - 0.5 * table[:, 3:6])


def _sphere_distance(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.sum((points - table[:, :3]) ** 2, axis=-1)) - table[:, 3]


DISTANCES = {"cylinders": _cylinder_distance, "boxes": _box_distance, "spheres": _sphere_distance}
"""By table: signed distances [m], [.., n], of points [.., 1, 3] or [3] to every row [n, k]; negative inside.

Points [.., n, 3] differ by row.
"""
