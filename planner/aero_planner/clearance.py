"""Exact distance to the nearest point of the filtered cloud, truncated where it no longer matters.

The space around the drone is cut into cubic cells at least as wide as the largest distance that is asked for, so that
all points that count for a position lie in the 27 cells around it. Points are sorted by cell, rows of cells along x one
after another. Every point is entered in the layers below and above its own, too, and where that pays (on a CPU) also in
the rows beside its own: the 27 cells are then one piece of the list, otherwise three. Nothing is approximated.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from aero_planner.params import Params

__all__ = [
    "FAR",
    "GRID",
    "WIDTH",
    "PointBlock",
    "PointList",
    "allocate_rows",
    "cell_size",
    "clearance_at",
    "count_points",
    "fill_rows",
    "query_clearance",
    "row_limit",
]

# Loops over a block stay loops, which LLVM turns into vector instructions.
wp.set_module_options({"enable_backward": False, "max_unroll": 4})

GRID = wp.constant(42)
"""Cells along each side of the grid; the outermost hold no points, so that every point has 27 cells around it."""

WIDTH = wp.constant(16)
"""Points in a block of the list, which a CPU handles at once. A row begins and ends anywhere in a block: what else the
block holds are points of the cloud, too."""

FAR = wp.constant(1.0e18)
"""Coordinate of what fills up the last block."""

Reals: Any = wp.types.vector(length=16, dtype=wp.float32)
PointBlock: Any = wp.types.matrix(shape=(3, 16), dtype=wp.float32)
"""x, y and z of a block's points."""


@wp.struct
class PointList:
    """The points by cell."""

    beside: int
    """1 where points are entered in the rows beside their own as well, else 0."""
    end: wp.array2d(dtype=int)
    """Where each cell's points end, shape [B, GRID^3]; they begin where those of the cell before in the row end."""
    blocks: wp.array2d(dtype=PointBlock)
    """Points of all rows [m], shape [B, blocks], world frame."""


@wp.func
def cell_size(params: Params) -> float:
    """Width of a cell [m]."""
    return wp.max(
        wp.max(params.distance_max, params.blocked_radius),
        wp.max(params.safe_clearance, 2.0 * params.range_max / float(GRID - 2)),
    )


@wp.func
def grid_coordinates(x: wp.vec3, center: wp.vec3, size: float) -> wp.vec3:
    """Position in cells from the grid's corner."""
    return (x - center) * (1.0 / size) + wp.vec3(0.5 * float(GRID), 0.5 * float(GRID), 0.5 * float(GRID))


@wp.func
def cell_of_point(x: wp.vec3, center: wp.vec3, size: float):
    c = grid_coordinates(x, center, size)
    # A point at exactly range_max may round to the cell past the last one.
    last = GRID - 2
    return wp.clamp(int(c[0]), 1, last), wp.clamp(int(c[1]), 1, last), wp.clamp(int(c[2]), 1, last)


@wp.kernel
def count_points(
    lane: int,
    lanes: int,
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    list: PointList,
):
    """Count the points of each cell in `end`. Launched over [B, fine cells]; a lane has every `lanes`-th layer."""
    b, i = wp.tid()
    if occupied[b, i] == 0:
        return
    cx, cy, cz = cell_of_point(filtered[b, i], position[b], cell_size(params[b]))
    for z in range(cz - 1, cz + 2):
        if z % lanes == lane:
            for y in range(cy - list.beside, cy + list.beside + 1):
                wp.atomic_add(list.end, b, (z * GRID + y) * GRID + cx, 1)


@wp.kernel
def allocate_rows(
    lane: int,
    lanes: int,
    capacity: int,
    list: PointList,
    total: wp.array2d(dtype=int),
):
    """Give each row of cells a piece of this lane's `capacity` points; `end` becomes where each cell begins. Launched
    over [B, rows of the lane].

    Which piece a row gets depends on the order of the threads; the nearest distance does not.
    """
    b, i = wp.tid()
    first = ((i // GRID) * lanes + lane) * GRID * GRID + (i % GRID) * GRID
    length = int(0)
    for x in range(GRID):
        length += list.end[b, first + x]
    if length == 0:
        return
    cursor = lane * capacity + wp.atomic_add(total, lane, b, length)
    for x in range(GRID):
        count = list.end[b, first + x]
        list.end[b, first + x] = cursor
        cursor += count


@wp.kernel
def fill_rows(
    lane: int,
    lanes: int,
    capacity: int,
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    total: wp.array2d(dtype=int),
    list: PointList,
    coordinates: wp.array4d(dtype=float),
):
    """Write every point into its cells; `coordinates` are those of the blocks, shape [B, blocks, 3, WIDTH]. Launched
    over [B, fine cells]."""
    b, i = wp.tid()
    if i == 0:
        end = lane * capacity + total[lane, b]
        for slot in range(end, (end + WIDTH - 1) // WIDTH * WIDTH):
            coordinates[b, slot // WIDTH, 0, slot % WIDTH] = FAR
    if occupied[b, i] == 0:
        return
    point = filtered[b, i]
    cx, cy, cz = cell_of_point(point, position[b], cell_size(params[b]))
    for z in range(cz - 1, cz + 2):
        if z % lanes == lane:
            for y in range(cy - list.beside, cy + list.beside + 1):
                slot = wp.atomic_add(list.end, b, (z * GRID + y) * GRID + cx, 1)
                block = slot // WIDTH
                j = slot % WIDTH
                coordinates[b, block, 0, j] = point[0]
                coordinates[b, block, 1, j] = point[1]
                coordinates[b, block, 2, j] = point[2]


@wp.func
def clearance_at(x: wp.vec3, limit: float, b: int, center: wp.vec3, size: float, list: PointList) -> float:
    """Distance from x to the nearest point [m], or `limit` where that is farther; `limit` must not exceed `size`."""
    c = grid_coordinates(x, center, size)
    cx = int(wp.floor(c[0]))
    cy = int(wp.floor(c[1]))
    cz = int(wp.floor(c[2]))
    if wp.min(cx, wp.min(cy, cz)) < 0 or wp.max(cx, wp.max(cy, cz)) >= GRID:
        return limit
    best = Reals(limit * limit)
    side = 1 - list.beside
    for y in range(wp.max(cy - side, 0), wp.min(cy + side, GRID - 1) + 1):
        row = (cz * GRID + y) * GRID
        # The first cell of a row is empty, so that the row begins where that one ends.
        first = list.end[b, row + wp.max(cx - 2, 0)]
        last = list.end[b, row + wp.min(cx + 1, GRID - 1)]
        if first < last:
            for k in range(first // WIDTH, (last + WIDTH - 1) // WIDTH):
                block = list.blocks[b, k]
                for j in range(WIDTH):
                    dx = block[0, j] - x[0]
                    dy = block[1, j] - x[1]
                    dz = block[2, j] - x[2]
                    d = dx * dx + dy * dy + dz * dz
                    best[j] = wp.where(d < best[j], d, best[j])
    # By halves, which takes four dependent steps instead of sixteen.
    for j in range(8):
        best[j] = wp.where(best[j + 8] < best[j], best[j + 8], best[j])
    for j in range(4):
        best[j] = wp.where(best[j + 4] < best[j], best[j + 4], best[j])
    return wp.sqrt(wp.min(wp.min(best[0], best[1]), wp.min(best[2], best[3])))


@wp.func
def row_limit(t: int, steps: int, params: Params) -> float:
    """Distance beyond which row t of a rollout need not be known [m]; rows from `steps` on are probes."""
    if t >= steps:
        return params.blocked_radius
    return wp.max(params.distance_max, params.safe_clearance)


@wp.kernel
def query_clearance(
    first: int,
    instances: int,
    steps: int,
    stride: int,
    positions: wp.array4d(dtype=float),
    center: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    list: PointList,
    distance: wp.array3d(dtype=float),
):
    """Clearance of every position, shape [B M, N + probes, 3, K]; rows past `steps` probe the way to the goal.

    Launched over [instances of this chunk, N + probes, stride]; a thread takes every `stride`-th of the K positions.
    """
    offset, t, lane = wp.tid()
    i = first + offset
    b = i // instances
    limit = row_limit(t, steps, params[b])
    size = cell_size(params[b])
    unused = t >= steps and params[b].q_blocked == 0.0
    for k in range(lane, distance.shape[2], stride):
        if unused:
            distance[i, t, k] = limit
        else:
            x = wp.vec3(positions[i, t, 0, k], positions[i, t, 1, k], positions[i, t, 2, k])
            distance[i, t, k] = clearance_at(x, limit, b, center[b], size, list)
