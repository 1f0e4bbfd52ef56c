"""Registration of a cloud with a surface by multi-scale point-to-plane ICP, and whether the result can be trusted."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from aero_viz.open3d_clouds import import_open3d, point_cloud

Array = NDArray[np.float64]

_SCALES = ((1.0, 3.0), (0.5, 1.0), (0.25, 0.5))
"""Voxels of both clouds and largest distance of matched points, from coarse to fine [m], [m]."""
_NORMAL_NEIGHBOURS = 20
_ITERATIONS = 30
_NEAR = 0.25
"""A point this near to the surface lies on it [m]."""
_REACH = 1.0
"""Points farther from any point of the surface are of what it lacks, and say nothing about the pose [m]."""
_POINTS_MIN = 30
"""Fewer points are no surface."""
_HOLD_MIN = 0.005
"""Flat ground and tunnels hold with up to 0.0015, three trunks in a field with 0.002 to 0.004."""


class Fit(NamedTuple):
    """The pose at which a cloud fits a surface best."""

    pose: Array
    """Pose of the cloud in the frame of the surface [4, 4]."""
    fitness: float
    """Share of the points of the cloud that lie on the surface, weighted by how much they settle the pose."""
    hold: float
    """Least share of the points that keeps the cloud from moving in some direction, or from turning."""

    def problem(self, *, least: float) -> str:
        """Return why the pose cannot be trusted with a fitness of at least `least`; empty if it can."""
        if self.fitness < least:
            return f"it fits only to {self.fitness:.0%}"
        if self.hold < _HOLD_MIN:
            return "its surfaces leave a direction open, as flat ground and tunnels do"
        return ""


class Surface:
    """Points of a surface with their normals, on several scales.

    Args:
        points: [n, 3] [m].
    """

    def __init__(self, points: NDArray[np.floating]) -> None:
        # Maps may be far from the origin, where a small turn moves points by metres.
        self._origin = points.mean(axis=0, dtype=np.float64) if len(points) else np.zeros(3)
        whole = point_cloud(points - self._origin)
        search = import_open3d().geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS)
        self._clouds = []
        for voxel, _ in _SCALES:
            cloud = whole.voxel_down_sample(voxel)
            cloud.estimate_normals(search)
            self._clouds.append(cloud)
        self._fine = np.asarray(self._clouds[-1].points)
        self._normals = np.asarray(self._clouds[-1].normals)
        self._tree = KDTree(self._fine) if len(self._fine) else None

    def fit(self, points: NDArray[np.floating], guess: Array) -> Fit:
        """Return the pose near `guess` [4, 4] at which a cloud [n, 3] [m] fits."""
        if min(len(points), len(self._fine)) < _POINTS_MIN:
            return Fit(guess, 0.0, 0.0)
        registration = import_open3d().pipelines.registration
        cloud, pose = point_cloud(points), self._moved(guess, -self._origin)
        source = cloud
        criteria = registration.ICPConvergenceCriteria(max_iteration=_ITERATIONS)
        for target, (voxel, distance) in zip(self._clouds, _SCALES, strict=True):
            kernel = registration.TukeyLoss(k=distance)
            estimation = registration.TransformationEstimationPointToPlane(kernel)
            source = cloud.voxel_down_sample(voxel)
            pose = registration.registration_icp(source, target, distance, pose, estimation, criteria).transformation
        fitness, hold = self._judge(source, np.asarray(pose))
        return Fit(self._moved(pose, self._origin), fitness, hold)

    @staticmethod
    def _moved(pose: Array, offset: Array) -> Array:
        moved = np.array(pose)
        moved[:3, 3] += offset
        return moved

    def _judge(self, cloud: Any, pose: Array) -> tuple[float, float]:
        """Return fitness and hold of a cloud of Open3D at a pose.

        The ground has most of the points, and fits wherever the drone is at the right height. A point therefore counts
        by its leverage, the share by which it settles the pose (Belsley, Kuh and Welsch 1980): trunks count more.
        """
        assert self._tree is not None
        cloud.estimate_normals(import_open3d().geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        points = np.asarray(cloud.points)
        rows = _motion_rows(points, np.asarray(cloud.normals))
        leverage = np.einsum("ni,ij,nj->n", rows, np.linalg.pinv(rows.T @ rows), rows)
        points = points @ pose[:3, :3].T + pose[:3, 3]
        distance, index = map(np.asarray, self._tree.query(points, distance_upper_bound=_REACH))
        near = np.isfinite(distance)
        offset = np.full(len(points), np.inf)
        normals = self._normals[index[near]]
        offset[near] = np.abs(np.einsum("ni,ni->n", points[near] - self._fine[index[near]], normals))
        lies = offset < _NEAR
        if not lies.any():
            return 0.0, 0.0
        held = _motion_rows(points[lies] - pose[:3, 3], normals[lies[near]])
        hold = float(np.linalg.eigvalsh(held.T @ held / len(held))[0])
        return float(leverage[lies].sum() / leverage.sum()), hold


def _motion_rows(points: Array, normals: Array) -> Array:
    """Return by how much points [n, 3] leave their planes when the body turns, in mean distances, or moves [n, 6]."""
    lever = points / max(float(np.sqrt((points**2).sum(axis=1).mean())), 1e-9)
    return np.concatenate([np.cross(lever, normals), normals], axis=1)
