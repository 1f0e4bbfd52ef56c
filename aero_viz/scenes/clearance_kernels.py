"""Warp kernels of the clearance grid: distances around primitives and triangles, reachability, and shortest routes."""

from __future__ import annotations

import warp as wp

from aero_viz.scenes.geometry import Primitive, primitive_distance
from aero_viz.scenes.triangles import mesh_distance

ROUTE_BUCKETS = 18
"""Number of buckets of `route_kernel`, more than the cost of its longest step."""

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


@wp.func
def _unlink(
    point: int, bucket: int, head: wp.array(dtype=int), following: wp.array(dtype=int), previous: wp.array(dtype=int)
):
    """Take a point out of the list of its bucket."""
    if previous[point] >= 0:
        following[previous[point]] = following[point]
    else:
        head[bucket] = following[point]
    if following[point] >= 0:
        previous[following[point]] = previous[point]


@wp.kernel
def route_kernel(
    # problem
    distance: wp.array(dtype=float),  # [X Y Z]
    shape: wp.vec3i,
    threshold: float,
    start: int,
    goal: int,
    # workspace
    head: wp.array(dtype=int),  # [ROUTE_BUCKETS], filled with -1
    following: wp.array(dtype=int),  # [X Y Z]
    previous: wp.array(dtype=int),  # [X Y Z]
    cost: wp.array(dtype=int),  # [X Y Z], filled with 2^30
    # out
    parent: wp.array(dtype=int),  # [X Y Z], filled with -1
):
    """Shortest route over 26-connected points by one thread: Dial's variant of Dijkstra's algorithm.

    A step along one, two or three axes costs 10, 14 or 17. Points wait in the bucket of their cost modulo the number of
    buckets, each of which is a doubly linked list.
    """
    waiting = int(1)
    level = int(0)
    cost[start] = 0
    parent[start] = start
    following[start] = -1
    previous[start] = -1
    head[0] = start
    while waiting > 0:
        while head[level % head.shape[0]] < 0:
            level += 1
        point = head[level % head.shape[0]]
        _unlink(point, level % head.shape[0], head, following, previous)
        waiting -= 1
        if point == goal:
            waiting = 0
            break
        z = point % shape[2]
        y = point // shape[2] % shape[1]
        x = point // (shape[2] * shape[1])
        for i in range(27):
            dx = i // 9 - 1
            dy = i // 3 % 3 - 1
            dz = i % 3 - 1
            inside_x = x + dx >= 0 and x + dx < shape[0]
            inside_y = y + dy >= 0 and y + dy < shape[1]
            inside_z = z + dz >= 0 and z + dz < shape[2]
            if i != 13 and inside_x and inside_y and inside_z:
                neighbour = point + (dx * shape[1] + dy) * shape[2] + dz
                axes = wp.abs(dx) + wp.abs(dy) + wp.abs(dz)
                step = int(10)
                if axes == 2:
                    step = int(14)
                elif axes == 3:
                    step = int(17)
                if distance[neighbour] >= threshold and level + step < cost[neighbour]:
                    if parent[neighbour] >= 0:
                        _unlink(neighbour, cost[neighbour] % head.shape[0], head, following, previous)
                    else:
                        waiting += 1
                    cost[neighbour] = level + step
                    parent[neighbour] = point
                    bucket = (level + step) % head.shape[0]
                    following[neighbour] = head[bucket]
                    previous[neighbour] = -1
                    if head[bucket] >= 0:
                        previous[head[bucket]] = neighbour
                    head[bucket] = neighbour
