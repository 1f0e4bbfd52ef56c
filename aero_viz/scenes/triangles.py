"""Triangulated surfaces: a bounding volume hierarchy on a device, with distance and ray queries for kernels.

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import init_warp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e9)


@wp.func
def mesh_distance(mesh: wp.uint64, point: wp.vec3, limit: float):
    """Distance to the nearest triangle [m]; inf if none is within `limit` [m], or if there is no mesh (0)."""
    if mesh == wp.uint64(0):
        return wp.inf
    query = wp.mesh_query_point_no_sign(mesh, point, limit)
    if not query.result:
        return wp.inf
    return wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - point)


@wp.func
def mesh_range(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, limit: float):
    """Distance along a unit direction to the nearest triangle, hit from either side [m]; inf as in `mesh_distance`."""
    if mesh == wp.uint64(0):
        return wp.inf
    query = wp.mesh_query_ray(mesh, origin, direction, wp.min(limit, FAR))
    return wp.where(query.result, query.t, wp.inf)


@wp.kernel
def nearest_kernel(
    # problem
    mesh: wp.uint64,
    # in
    points: wp.array(dtype=wp.vec3),  # [n]
    # out
    distance: wp.array(dtype=float),  # [n]
    face: wp.array(dtype=int),  # [n]
):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], FAR)
    distance[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])
    face[i] = query.face


class TriangleTree:
    """A bounding volume hierarchy over triangles on a device.

    Args:
        triangles: three corners per row [m], [n, 9], n >= 1.
        device: Warp device.

    Attributes:
        id: identifier for `mesh_distance` and `mesh_range`, valid as long as this object lives.
    """

    def __init__(self, triangles: NDArray[np.float64], *, device: Any = "cpu") -> None:
        corners = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
        init_warp()
        with wp.ScopedDevice(device):
            points = wp.array(corners, dtype=wp.vec3)
            self._mesh = wp.Mesh(points=points, indices=wp.array(np.arange(len(corners)), dtype=int))
        self.id = self._mesh.id

    def nearest(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the distance from each of `points` [m], [n, 3], to the nearest triangle [m], [n], and its row, [n]."""
        positions = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        with wp.ScopedDevice(self._mesh.device):
            distance, face = wp.empty(len(positions), dtype=float), wp.empty(len(positions), dtype=int)
            inputs = [self.id, wp.array(positions, dtype=wp.vec3)]
            wp.launch(nearest_kernel, len(positions), inputs=inputs, outputs=[distance, face])
        return distance.numpy().astype(np.float64), face.numpy().astype(np.int64)
