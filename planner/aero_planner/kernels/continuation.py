"""Surfaces continued past the edges of the field of view: space that was not seen is not free."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.dynamics import quat_inverse_rotate, quat_rotate
from aero_planner.kernels.params import Params
from aero_planner.kernels.partition import cell_of_direction, farthest

__all__ = ["continue_surfaces"]

wp.set_module_options({"enable_backward": False})

_ROWS_INSIDE = wp.constant(2)
"""Rows inside the field of view that are searched for a surface at its edge; beam patterns do not fill the last one."""


@wp.kernel
def continue_surfaces(
    # share of the cells
    worker: int,
    workers: int,
    # problem
    position: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    # configuration
    params: wp.array(dtype=Params),
    columns: int,
    # in
    directions: wp.array2d(dtype=wp.vec3),
    # in and out
    fine_range: wp.array2d(dtype=float),
    occupied: wp.array2d(dtype=int),
    filtered_points: wp.array2d(dtype=wp.vec3),
):
    """Fill empty cells outside the field of view with the continuation of the surface at its edge.

    Below the field of view the nearest point above continues straight down, by at most continue_below. Above it, the
    nearest point below continues horizontally, if it is at most continue_above higher than the drone. Filled cells are
    marked by `occupied` = 2. Workers run at the same time: a cell is filled from cells that are not. Launched over
    [B, fine cells / workers, rounded up].
    """
    b, i = wp.tid()
    cell = i * workers + worker
    if cell >= fine_range.shape[1]:
        return
    c = params[b]
    if occupied[b, cell] == 1 or (c.continue_below <= 0.0 and c.continue_above <= 0.0):
        return
    row = cell // columns
    rows = directions.shape[0]
    height = wp.PI / float(rows)
    elevation = (float(row) + 0.5) * height - 0.5 * wp.PI
    below = elevation < wp.radians(c.view_min) and c.continue_below > 0.0
    above = elevation > wp.radians(c.view_max) and c.continue_above > 0.0
    if not (below or above):
        return
    q = wp.normalize(quaternion[b])
    p = position[b]
    d = quat_rotate(q, directions[row, cell % columns])
    flat = wp.sqrt(d[0] * d[0] + d[1] * d[1])
    if flat < 0.2 or (above and d[2] < 0.1):
        return
    ahead = wp.vec3(d[0] / flat, d[1] / flat, 0.0)
    start = wp.atan2(d[2], flat)
    side = wp.where(below, 1.0, -1.0)
    lowest = wp.sin(wp.radians(c.view_min))
    highest = wp.sin(wp.radians(c.view_max))
    inside = int(0)
    for k in range(1, rows // 2):
        angle = start + side * float(k) * height
        if inside < _ROWS_INSIDE and wp.abs(angle) < 0.5 * wp.PI:
            body = quat_inverse_rotate(q, wp.cos(angle) * ahead + wp.vec3(0.0, 0.0, wp.sin(angle)))
            if body[2] >= lowest and body[2] <= highest:
                inside += 1
            source_row, source_column = cell_of_direction(body, rows, columns)
            source = source_row * columns + source_column
            if occupied[b, source] == 1:
                inside = _ROWS_INSIDE
                offset = filtered_points[b, source] - p
                away = wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
                x = p + away * ahead + wp.vec3(0.0, 0.0, away * wp.tan(start))
                is_continued = below and filtered_points[b, source][2] - x[2] <= c.continue_below
                if above:
                    x = p + (offset[2] / d[2]) * d
                    is_continued = offset[2] > 0.0 and offset[2] <= c.continue_above
                distance = wp.length(x - p)
                if is_continued and distance <= farthest(c):
                    fine_range[b, cell] = distance
                    filtered_points[b, cell] = x
                    occupied[b, cell] = 2
