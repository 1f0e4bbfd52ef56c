"""Drift of the autopilot's estimate, measured by the LiDAR: the cloud of one moment against that of the next.

If position and attitude are right, what stands still stays where it is in the world frame. The motion that brings the
newer points onto the older ones is therefore an error of the estimate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_RADIUS = 15.0  # [m] within which points are used
_VOXEL = 1.0  # [m]
_VOXEL_POINTS = 8
_MAX_THICKNESS = 0.15  # [m] of a surface in a voxel
_MAX_POINTS = 5_000  # of each cloud
_MIN_MATCHES = 150
_HUBER = 0.1  # [m]
_PRIOR_ANGLE, _PRIOR_SHIFT = 0.1, 0.5  # [rad], [m]; standard deviations before anything is seen
_POINT_ERROR = 0.5  # [m]; large, because the errors of neighbouring points are alike
_ROUNDS = 3


class Drift(NamedTuple):
    """The motion of the newer points relative to the older ones."""

    angle: float
    """[rad]"""
    displacement: Array
    """At the drone [m], shape [3], world frame."""

    @property
    def shift(self) -> float:
        """Norm of the displacement [m]."""
        return float(np.linalg.norm(self.displacement))


def measure_drift(old: NDArray[np.float32], new: NDArray[np.float32], position: Array) -> Drift | None:
    """Return how far `new` has moved against `old`; None if too little is visible to tell.

    The older points are divided into voxels with a plane in each. A rigid motion is fitted that moves the newer points
    onto these planes. Directions in which nothing holds the points count as free of drift.

    Args:
        old: Points [m], shape [P, 3], world frame.
        new: Points of a later time, in the same form.
        position: Position of the drone [m], shape [3].
    """
    old_near, new_near = _near(old, position), _near(new, position)
    planes = _fit_planes(old_near)
    if planes is None:
        return None
    keys, means, normals = planes
    motion = np.zeros(6)
    information = np.diag([_PRIOR_ANGLE**-2.0] * 3 + [_PRIOR_SHIFT**-2.0] * 3)
    total = information
    for _ in range(_ROUNDS):
        moved = new_near + np.cross(motion[:3], new_near) + motion[3:]
        voxel = _voxel_keys(moved)
        index = np.minimum(np.searchsorted(keys, voxel), len(keys) - 1)
        matched = keys[index] == voxel
        if matched.sum() < _MIN_MATCHES:
            return None
        points, normal = moved[matched], normals[index[matched]]
        error = ((points - means[index[matched]]) * normal).sum(axis=1)
        weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(error), 1e-9)) / _POINT_ERROR**2
        jacobian = np.concatenate([np.cross(points, normal), normal], axis=1)
        total = information + (jacobian * weight[:, None]).T @ jacobian
        motion = motion + np.linalg.solve(total, -(jacobian * weight[:, None]).T @ error - information @ motion)
    return Drift(float(np.linalg.norm(motion[:3])), -motion[3:])  # the motion brings the newer points back


def _near(points: NDArray[np.float32], position: Array) -> Array:
    relative = points.astype(np.float64) - position
    relative = relative[(relative**2).sum(axis=1) < _RADIUS**2]
    return relative[:: len(relative) // _MAX_POINTS + 1]


def _voxel_keys(points: Array) -> NDArray[np.int64]:
    size = 2 * math.ceil(_RADIUS / _VOXEL) + 8
    cell = np.floor(points / _VOXEL).astype(np.int64) + size // 2
    return np.where(((cell >= 0) & (cell < size)).all(axis=1), (cell[:, 0] * size + cell[:, 1]) * size + cell[:, 2], -1)


def _fit_planes(points: Array) -> tuple[NDArray[np.int64], Array, Array] | None:
    """Return the keys of voxels that hold a surface, sorted, with its mean and its normal."""
    if len(points) < _MIN_MATCHES:
        return None
    keys, voxel, count = np.unique(_voxel_keys(points), return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(voxel, points[:, k]) for k in range(3)], axis=1) / count[:, None]
    centred = points - mean[voxel]
    covariance = np.empty((len(keys), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = np.bincount(voxel, centred[:, i] * centred[:, j]) / count
    values, vectors = np.linalg.eigh(covariance)
    is_surface = (count >= _VOXEL_POINTS) & (values[:, 0] < _MAX_THICKNESS**2) & (values[:, 1] > 4.0 * values[:, 0])
    if not is_surface.any():
        return None
    return keys[is_surface], mean[is_surface], vectors[is_surface, :, 0]
