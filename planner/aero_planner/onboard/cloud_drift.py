"""Drift of the autopilot's estimate, measured by the LiDAR: the cloud of one moment against that of the next.

If position and attitude are right, static obstacles stay in place in the world frame. The motion that brings the newer
points onto the older ones is therefore an error of the estimate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_Planes = tuple[NDArray[np.int64], Array, Array]
"""Keys of voxels, sorted, and mean and normal of the surface in each."""

_RADIUS = 15.0  # [m] within which points are used
_VOXEL = 1.0  # [m]
_VOXEL_POINTS = 8
_MAX_THICKNESS = 0.15  # [m] of a surface in a voxel
_MAX_POINTS = 5_000  # of each cloud
_MIN_MATCHES = 150
_MAX_SHIFT_STD = 0.05  # [m] of a direction in which a shift is measured
_HUBER = 0.1  # [m]
_PRIOR_ANGLE, _PRIOR_SHIFT = 0.1, 0.5  # [rad], [m]; standard deviations before anything is seen
_POINT_ERROR = 0.5  # [m]; large, because the errors of neighbouring points are alike
_ROUNDS = 3
_SECTORS = 8  # parts of the view, by azimuth
_SECTOR_POINTS = 20
_DIRECTIONS = 60  # cells per turn, in azimuth and in elevation, that tell where the older points look
# From one interval of 0.2 s to the next, in rigid scenes of the simulator, at up to 5 m/s and while the drone turns,
# the coverage is at least 0.88 and the sectors agree to 0.05 m in nine of ten; among pillars that move, in one of ten.
_MIN_COVERAGE = 0.88  # part of the newer points, where the older ones look, in voxels that have older ones
_MAX_DISAGREEMENT = 0.06  # [m]


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
    """Return how far `new` has moved against `old`; None if too little is visible, or the visible obstacles move.

    The older points are divided into voxels with a plane in each. A rigid motion is fitted that moves the newer points
    onto these planes. Directions in which little holds the points, such as the vertical among pillars, count as free of
    drift. An error of the estimate displaces everything alike. If the sectors of the view are displaced differently, or
    many of the newer points are where none was before although the sensor looked there, obstacles move.

    Args:
        old: Points [m], shape [P, 3], world frame.
        new: Points of a later time, in the same form.
        position: Position of the drone [m], shape [3].
    """
    old_near, new_near = _near(old, position), _near(new, position)
    planes = _fit_planes(old_near)
    if planes is None:
        return None
    motion = np.zeros(6)
    total = information = np.diag([_PRIOR_ANGLE**-2.0] * 3 + [_PRIOR_SHIFT**-2.0] * 3)
    for _ in range(_ROUNDS):
        points, normals, errors = _match(_move(new_near, motion), planes)
        if len(points) < _MIN_MATCHES:
            return None
        weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(errors), 1e-9)) / _POINT_ERROR**2
        jacobian = np.concatenate([np.cross(points, normals), normals], axis=1)
        total = information + (jacobian * weight[:, None]).T @ jacobian
        motion = motion + np.linalg.solve(total, -(jacobian * weight[:, None]).T @ errors - information @ motion)
    moved = _move(new_near, motion)
    # A drone that tilts sees what it did not see before. That is no motion.
    in_view = moved[np.isin(_direction_keys(moved), _direction_keys(old.astype(np.float64) - position))]
    coverage = np.isin(_voxel_keys(in_view), _voxel_keys(old_near)).mean() if len(in_view) else 0.0
    if coverage < _MIN_COVERAGE or _sector_disagreement(*_match(moved, planes)) > _MAX_DISAGREEMENT:
        return None
    covariance = np.asarray(np.linalg.inv(total)[3:, 3:], dtype=np.float64)
    # The motion brings the newer points back.
    return Drift(float(np.linalg.norm(motion[:3])), -_measured_part(motion[3:], covariance))


def _measured_part(shift: Array, covariance: Array) -> Array:
    """Return the part of a shift [m], shape [3], along those axes of its covariance whose deviation is small."""
    variances, axes = np.linalg.eigh(covariance)
    kept = axes[:, variances < _MAX_SHIFT_STD**2]
    return kept @ (kept.T @ shift)


def _move(points: Array, motion: Array) -> Array:
    """Return the points after a small rotation vector [rad] and a shift [m], both in `motion`, shape [6]."""
    return points + np.cross(motion[:3], points) + motion[3:]


def _match(points: Array, planes: _Planes) -> tuple[Array, Array, Array]:
    """Return the points in voxels that hold a surface, the normals there, and the distances from the planes."""
    keys, means, normals = planes
    voxel = _voxel_keys(points)
    index = np.minimum(np.searchsorted(keys, voxel), len(keys) - 1)
    matched = keys[index] == voxel
    points, normals, means = points[matched], normals[index[matched]], means[index[matched]]
    return points, normals, ((points - means) * normals).sum(axis=1)


def _sector_disagreement(points: Array, normals: Array, errors: Array) -> float:
    """Return the root mean square of the horizontal shifts [m] that the sectors need beyond the fitted motion.

    Args:
        points: Matched points [m] relative to the drone, shape [P, 3].
        normals: Normals of their planes, shape [P, 3].
        errors: Distances from their planes after the fit [m], shape [P].
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * math.pi) + 0.5
    sector = np.minimum((azimuth * _SECTORS).astype(np.int64), _SECTORS - 1)
    prior = np.eye(2) * (_POINT_ERROR / _PRIOR_SHIFT) ** 2
    squares, weights = [0.0], [1e-9]  # an average over no sector is 0
    for k in range(_SECTORS):
        inside = sector == k
        if inside.sum() >= _SECTOR_POINTS:
            normal = normals[inside, :2]
            information = normal.T @ normal
            shift = np.linalg.solve(information + prior, normal.T @ errors[inside])
            squares.append(float(shift @ shift))
            weights.append(float(np.trace(information)))
    return math.sqrt(np.average(squares, weights=weights))


def _near(points: NDArray[np.float32], position: Array) -> Array:
    relative = points.astype(np.float64) - position
    relative = relative[(relative**2).sum(axis=1) < _RADIUS**2]
    return relative[:: len(relative) // _MAX_POINTS + 1]


def _voxel_keys(points: Array) -> NDArray[np.int64]:
    size = 2 * math.ceil(_RADIUS / _VOXEL) + 8
    cell = np.floor(points / _VOXEL).astype(np.int64) + size // 2
    return np.where(((cell >= 0) & (cell < size)).all(axis=1), (cell[:, 0] * size + cell[:, 1]) * size + cell[:, 2], -1)


def _direction_keys(points: Array) -> NDArray[np.int64]:
    """Return the number of the cell of directions in which each point [m], shape [P, 3], is seen."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    cell = np.floor(np.stack([azimuth, elevation]) * (_DIRECTIONS / (2.0 * math.pi))).astype(np.int64)
    return cell[0] * 2 * _DIRECTIONS + cell[1]


def _fit_planes(points: Array) -> _Planes | None:
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
