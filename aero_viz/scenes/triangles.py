"""Surfaces of triangles: a bounding volume hierarchy over them, and their files (OBJ, STL, GLB, OFF, PLY with faces).

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

# The body of a Warp kernel is not Python: queries have other types there.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import quieten

__all__ = ["TriangleTree", "mesh_distance", "mesh_range", "read_triangles"]

wp.set_module_options({"enable_backward": False})

_FAR = wp.constant(1.0e9)

Triangles = NDArray[np.float64]


@wp.func
def mesh_distance(mesh: wp.uint64, point: wp.vec3, limit: float):
    """Distance to the nearest triangle [m]; inf where there is none within `limit` [m] or no mesh, 0."""
    if mesh == wp.uint64(0):
        return wp.inf
    found = wp.mesh_query_point_no_sign(mesh, point, limit)
    if not found.result:
        return wp.inf
    return wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - point)


@wp.func
def mesh_range(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, limit: float):
    """Distance along a unit direction to the nearest triangle [m], from either side; inf as in `mesh_distance`."""
    if mesh == wp.uint64(0):
        return wp.inf
    found = wp.mesh_query_ray(mesh, origin, direction, wp.min(limit, _FAR))
    return wp.where(found.result, found.t, wp.inf)


@wp.kernel
def nearest_kernel(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), distance: wp.array(dtype=float), face: wp.array(dtype=int)
):
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], _FAR)
    distance[i] = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - points[i])
    face[i] = found.face


class TriangleTree:
    """A bounding volume hierarchy over triangles on a device.

    Args:
        triangles: corners x, y, z of each [m], shape [n, 9], n >= 1.
        device: Warp device.

    Attributes:
        id: to pass to `mesh_distance` and `mesh_range`; valid as long as this object lives.
    """

    def __init__(self, triangles: Triangles, *, device: Any = "cpu") -> None:
        corners = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
        quieten()
        with wp.ScopedDevice(device):
            points = wp.array(corners, dtype=wp.vec3)
            self._mesh = wp.Mesh(points=points, indices=wp.array(np.arange(len(corners)), dtype=int))
        self.id = self._mesh.id

    def nearest(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the distance to the nearest triangle [m], shape [n], and its row, [n], of points [m], [n, 3]."""
        places = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        device = self._mesh.device
        with wp.ScopedDevice(device):
            distance, face = wp.empty(len(places), dtype=float), wp.empty(len(places), dtype=int)
            wp.launch(nearest_kernel, len(places), [self.id, wp.array(places, dtype=wp.vec3)], [distance, face])
        return distance.numpy().astype(np.float64), face.numpy().astype(np.int64)


def read_triangles(path: str | Path) -> Triangles:
    """Return the triangles in a mesh's file [m], float64 [n, 9], without those that have no area; z is up.

    Raises:
        ValueError: the file is damaged; says how.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        corners = np.asarray(loaded.triangles, dtype=np.float64)
    except OSError:
        raise
    except Exception as error:  # trimesh raises what its parser happens to meet
        raise ValueError(f"its data are damaged ({type(error).__name__}: {error})") from error
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[area > 0.0].reshape(-1, 9)
