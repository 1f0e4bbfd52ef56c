"""What a cloud tells of a place where no world is known: whether it hides the place, and how its surface is turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.open3d_clouds import import_open3d, point_cloud

Array = NDArray[np.float64]

NEAR = 0.4
"""Distance up to which a point of the cloud belongs to a place on a surface [m]."""
_VOXEL = 0.1
"""Spacing to which clouds are thinned [m]."""
_AROUND = np.cos(np.radians(20.0))
_LINE = np.cos(np.radians(0.6))
"""Cosines of the angles from the line of sight within which points count, and within which one stands in the way."""
_SURELY_HIDDEN, _SURELY_VISIBLE = 1e3, 1e1
"""Radii of the inversion over the distance of the place: with a larger one, more points count as visible."""
_PATCH, _PATCH_POINTS, _FLAT = 0.3, 12, 0.1
"""Radius of a piece of surface [m], least number of points in it, and largest share of its extent across it."""


def is_hidden(points: NDArray[np.floating], eye: Array, place: Array) -> bool | None:
    """Return whether a cloud hides a place from an eye; None if it does not say for certain.

    Hidden points are found by inversion at a sphere and a convex hull (Katz, Tal and Basri 2007). How much they hide
    depends on the radius of the sphere. It is said to be hidden if it is for a large radius and a point stands in the
    line of sight, and visible if it is for a small one.

    Args:
        points: [n, 3] [m].
        eye, place: [3] [m].
    """
    distance = float(np.linalg.norm(place - eye))
    offset = points.astype(np.float64) - eye
    length = np.linalg.norm(offset, axis=1)
    before = (length > 1e-3) & (length < distance - NEAR)
    cosine = offset[before] @ (place - eye) / (length[before] * distance)
    around = point_cloud(offset[before][cosine > _AROUND]).voxel_down_sample(_VOXEL)
    cloud = np.vstack([np.asarray(around.points), place - eye])
    if len(cloud) < 5:
        return False
    is_seen = {radius: _sees_last(cloud, radius * distance) for radius in (_SURELY_HIDDEN, _SURELY_VISIBLE)}
    if not is_seen[_SURELY_HIDDEN] and (cosine > _LINE).any():
        return True
    return False if is_seen[_SURELY_VISIBLE] else None


def _sees_last(cloud: Array, radius: float) -> bool:
    """Return whether the last point of a cloud [n, 3] is visible from the origin."""
    try:
        _, visible = point_cloud(cloud).hidden_point_removal(np.zeros(3), radius)
    except RuntimeError:  # points in one plane have no hull
        return True
    return bool((np.asarray(visible) == len(cloud) - 1).any())


def surface_normal(points: NDArray[np.floating], place: Array) -> Array | None:
    """Return the unit normal [3], without a sign, of a surface in a cloud at a place [m]; None where it is not flat."""
    near = points[np.linalg.norm(points - place, axis=1) < _PATCH].astype(np.float64)
    if len(near) < _PATCH_POINTS:
        return None
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(near.T)), 0.0))
    if spread[0] > _FLAT * spread[1]:
        return None
    cloud = point_cloud(np.vstack([place, near]))
    cloud.estimate_normals(import_open3d().geometry.KDTreeSearchParamKNN(len(near) + 1))
    return np.asarray(cloud.normals)[0]
