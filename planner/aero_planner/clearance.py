"""Exact distance to the nearest point of the filtered cloud, truncated where it no longer matters.

Points are sorted into a cubic grid around the drone. A cell is at least as wide as the largest distance that is asked
for, so the 27 cells around a position hold every point that counts: nothing is approximated. Cells without a point in
those 27 are marked, which settles most positions with one look-up.
"""

from __future__ import annotations

import warp as wp

from aero_planner.params import Params

__all__ = [
    "GRID",
    "allocate_rows",
    "cell_size",
    "clearance_at",
    "count_points",
    "fill_cells",
    "query_clearance",
    "row_limit",
]

wp.set_module_options({"enable_backward": False})

GRID = wp.constant(40)
"""Cells along each side of the grid."""


@wp.func
def cell_size(params: Params) -> float:
    """Width of a cell [m]."""
    return wp.max(
        wp.max(params.distance_max, params.blocked_radius),
        wp.max(params.safe_clearance, 2.0 * params.range_max / float(GRID)),
    )


@wp.func
def grid_coordinates(x: wp.vec3, center: wp.vec3, size: float) -> wp.vec3:
    """Position in cells from the grid's corner."""
    return (x - center) / size + wp.vec3(0.5 * float(GRID), 0.5 * float(GRID), 0.5 * float(GRID))


@wp.func
def cell_of_point(x: wp.vec3, center: wp.vec3, size: float):
    c = grid_coordinates(x, center, size)
    # A point at exactly range_max may round to the cell past the last one.
    last = GRID - 1
    return wp.clamp(int(c[0]), 0, last), wp.clamp(int(c[1]), 0, last), wp.clamp(int(c[2]), 0, last)


@wp.kernel
def count_points(
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    count: wp.array2d(dtype=int),
    near: wp.array2d(dtype=wp.uint8),
):
    """Count the points of each cell and mark its neighbourhood. Launched over [B, fine cells]."""
    b, i = wp.tid()
    if occupied[b, i] == 0:
        return
    x, y, z = cell_of_point(filtered[b, i], position[b], cell_size(params[b]))
    wp.atomic_add(count, b, (z * GRID + y) * GRID + x, 1)
    for nz in range(wp.max(z - 1, 0), wp.min(z + 2, GRID)):
        for ny in range(wp.max(y - 1, 0), wp.min(y + 2, GRID)):
            for nx in range(wp.max(x - 1, 0), wp.min(x + 2, GRID)):
                near[b, (nz * GRID + ny) * GRID + nx] = wp.uint8(1)


@wp.kernel
def allocate_rows(
    count: wp.array2d(dtype=int), total: wp.array(dtype=int), start: wp.array2d(dtype=int), end: wp.array2d(dtype=int)
):
    """Give each row of cells along x a contiguous piece of the sorted points. Launched over [B, GRID^2].

    Which piece a row gets depends on the order of the threads; the nearest distance does not.
    """
    b, row = wp.tid()
    length = int(0)
    for x in range(GRID):
        length += count[b, row * GRID + x]
    cursor = int(0)
    if length > 0:
        cursor = wp.atomic_add(total, b, length)
    for x in range(GRID):
        cell = row * GRID + x
        start[b, cell] = cursor
        end[b, cell] = cursor
        cursor += count[b, cell]


@wp.kernel
def fill_cells(
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    end: wp.array2d(dtype=int),
    sorted_points: wp.array2d(dtype=wp.vec3),
):
    """Write every point into its cell; `end` becomes the end of each cell. Launched over [B, fine cells]."""
    b, i = wp.tid()
    if occupied[b, i] == 0:
        return
    x, y, z = cell_of_point(filtered[b, i], position[b], cell_size(params[b]))
    slot = wp.atomic_add(end, b, (z * GRID + y) * GRID + x, 1)
    sorted_points[b, slot] = filtered[b, i]


@wp.func
def clearance_at(
    x: wp.vec3,
    limit: float,
    b: int,
    center: wp.vec3,
    size: float,
    near: wp.array2d(dtype=wp.uint8),
    start: wp.array2d(dtype=int),
    end: wp.array2d(dtype=int),
    sorted_points: wp.array2d(dtype=wp.vec3),
) -> float:
    """Distance from x to the nearest point [m], or `limit` where that is farther; `limit` must not exceed `size`."""
    c = grid_coordinates(x, center, size)
    cx = int(wp.floor(c[0]))
    cy = int(wp.floor(c[1]))
    cz = int(wp.floor(c[2]))
    if cx < -1 or cy < -1 or cz < -1 or cx > GRID or cy > GRID or cz > GRID:
        return limit
    if cx >= 0 and cy >= 0 and cz >= 0 and cx < GRID and cy < GRID and cz < GRID:  # noqa: SIM102, `and` reads both
        if near[b, (cz * GRID + cy) * GRID + cx] == wp.uint8(0):
            return limit
    best = limit * limit
    for jz in range(3):
        dz = jz - 3 * (jz // 2)  # 0, 1, -1: the own layer first, since it shortens the others
        gap_z = wp.max(0.0, wp.max(float(cz + dz) - c[2], c[2] - float(cz + dz + 1))) * size
        for jy in range(3):
            dy = jy - 3 * (jy // 2)
            gap_y = wp.max(0.0, wp.max(float(cy + dy) - c[1], c[1] - float(cy + dy + 1))) * size
            y = cy + dy
            z = cz + dz
            if gap_y * gap_y + gap_z * gap_z < best and y >= 0 and z >= 0 and y < GRID and z < GRID:
                row = (z * GRID + y) * GRID
                first = start[b, row + wp.clamp(cx - 1, 0, GRID - 1)]
                last = end[b, row + wp.clamp(cx + 1, 0, GRID - 1)]
                for i in range(first, last):
                    d = sorted_points[b, i] - x
                    best = wp.min(best, wp.dot(d, d))
    return wp.sqrt(best)


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
    positions: wp.array3d(dtype=wp.vec3),
    center: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    near: wp.array2d(dtype=wp.uint8),
    start: wp.array2d(dtype=int),
    end: wp.array2d(dtype=int),
    sorted_points: wp.array2d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
):
    """Clearance of every position, shape [B M, N + probes, K]; rows past `steps` probe the way to the goal.

    Launched over [instances of this chunk, N + probes, K].
    """
    offset, t, k = wp.tid()
    i = first + offset
    b = i // instances
    limit = row_limit(t, steps, params[b])
    if t >= steps and params[b].q_blocked == 0.0:
        distance[i, t, k] = limit
        return
    size = cell_size(params[b])
    distance[i, t, k] = clearance_at(positions[i, t, k], limit, b, center[b], size, near, start, end, sorted_points)
