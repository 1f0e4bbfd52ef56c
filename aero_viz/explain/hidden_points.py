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
_AROUND, _LINE = np.cos(np.radians(20.0)), np.cos(np.radians(0.4))
"""Cosines of the angles from the line of sight within which points count, and within which they stand in the way."""
_BEFORE, _IN_WAY = 1.0, 2
"""Distance before the place from which points stand in the way [m], and the least number: a surface that the line of
sight grazes comes as near to it."""
_RADIUS = 1e3
"""Radius of the inversion over the distance of the place: with a larger one, fewer points count as hidden."""
_PATCH, _PATCH_POINTS, _FLAT = 0.3, 12, 0.1
"""Radius of a piece of surface [m], least number of points in it, and largest share of its extent across it."""


def hides(points: NDArray[np.floating], eye: Array, place: Array) -> bool:
    """Return True if a cloud certainly hides a place from an eye.

    Hidden points are found by inversion at a sphere and a convex hull (Katz, Tal and Basri 2007), and points must stand
    in the line of sight. Otherwise the place may still be hidden by what the cloud lacks.

    Args:
        points: [n, 3] [m].
        eye, place: [3] [m].
    """
    distance = float(np.linalg.norm(place - eye))
    offset = points.astype(np.float64) - eye
    length = np.linalg.norm(offset, axis=1)
    before = (length > 1e-3) & (length < distance - NEAR)
    offset, length = offset[before], length[before]
    cosine = offset @ (place - eye) / (length * max(distance, 1e-9))
    if ((cosine > _LINE) & (length < distance - _BEFORE)).sum() < _IN_WAY:
        return False
    around = point_cloud(offset[cosine > _AROUND]).voxel_down_sample(_VOXEL)
    cloud = np.vstack([np.asarray(around.points), place - eye])
    if len(cloud) < 5:
        return False
    try:
        _, visible = point_cloud(cloud).hidden_point_removal(np.zeros(3), _RADIUS * distance)
    except RuntimeError:  # points in one plane have no hull
        return False
    return not (np.asarray(visible) == len(cloud) - 1).any()


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
