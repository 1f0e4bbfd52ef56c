"""Warp kernels of the clearance grid: distances around primitives and triangles, and a breadth-first search."""

from __future__ import annotations

import warp as wp

from aero_viz.scenes.geometry import Primitive, primitive_distance
from aero_viz.scenes.triangles import mesh_distance

__all__ = ["distance_kernel", "flood_kernel", "mesh_distance_kernel"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def distance_kernel(
    # problem
    primitives: wp.array(dtype=Primitive),  # [P]
    lower: wp.array(dtype=wp.vec3),  # [P], box around each primitive within which it can lower a distance [m]
    upper: wp.array(dtype=wp.vec3),  # [P]
    corner: wp.vec3,
    cell: float,
    # in/out
    distance: wp.array3d(dtype=float),  # [X, Y, Z]
):
    """Lower the distances at the grid points around each primitive."""
    i = wp.tid()
    first = (lower[i] - corner) / cell
    last = (upper[i] - corner) / cell
    x_end = wp.min(int(wp.floor(last[0])) + 1, distance.shape[0])
    y_end = wp.min(int(wp.floor(last[1])) + 1, distance.shape[1])
    z_end = wp.min(int(wp.floor(last[2])) + 1, distance.shape[2])
    for x in range(wp.max(int(wp.ceil(first[0])), 0), x_end):
        for y in range(wp.max(int(wp.ceil(first[1])), 0), y_end):
            for z in range(wp.max(int(wp.ceil(first[2])), 0), z_end):
                point = corner + cell * wp.vec3(float(x), float(y), float(z))
                wp.atomic_min(distance, x, y, z, primitive_distance(primitives[i], point))


@wp.kernel
def mesh_distance_kernel(
    # problem
    mesh: wp.uint64,
    corner: wp.vec3,
    cell: float,
    distance_max: float,
    # in/out
    distance: wp.array3d(dtype=float),  # [X, Y, Z]
):
    """Lower the distances at all grid points to the distances to the triangles."""
    x, y, z = wp.tid()
    point = corner + cell * wp.vec3(float(x), float(y), float(z))
    distance[x, y, z] = wp.min(distance[x, y, z], mesh_distance(mesh, point, distance_max))


@wp.kernel
def flood_kernel(
    # problem
    distance: wp.array(dtype=float),  # [X Y Z]
    shape: wp.vec3i,
    threshold: float,
    start: int,
    goal: int,
    # workspace
    queue: wp.array(dtype=int),  # [X Y Z]
    # out
    reached: wp.array(dtype=wp.uint8),  # [X Y Z]
):
    """Breadth-first search by one thread, from `start` until `goal` is reached or the queue is empty."""
    head = int(0)
    tail = int(0)
    if distance[start] >= threshold:
        queue[0] = start
        reached[start] = wp.uint8(1)
        tail = 1
    while head < tail:
        point = queue[head]
        head += 1
        z = point % shape[2]
        y = point // shape[2] % shape[1]
        x = point // (shape[2] * shape[1])
        for k in range(6):
            neighbour = point
            if k == 0 and x > 0:
                neighbour = point - shape[2] * shape[1]
            elif k == 1 and x < shape[0] - 1:
                neighbour = point + shape[2] * shape[1]
            elif k == 2 and y > 0:
                neighbour = point - shape[2]
            elif k == 3 and y < shape[1] - 1:
                neighbour = point + shape[2]
            elif k == 4 and z > 0:
                neighbour = point - 1
            elif k == 5 and z < shape[2] - 1:
                neighbour = point + 1
            if reached[neighbour] == wp.uint8(0) and distance[neighbour] >= threshold:
                reached[neighbour] = wp.uint8(1)
                queue[tail] = neighbour
                tail += 1
                if neighbour == goal:
                    head = tail
                    break
