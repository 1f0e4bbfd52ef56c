"""Surfaces continued past the edges of the field of view: space that was not seen is not free."""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.dynamics import near_atan2, quat_inverse_rotate, quat_rotate
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.params import Params
from aero_planner.kernels.partition import cell_of_direction, farthest

wp.set_module_options({"enable_backward": False})

_ROWS_INSIDE = wp.constant(2)
"""Rows inside the field of view that are searched for a surface at its edge; beam patterns do not fill the last one."""
_UNSURE = wp.constant(-1)
_STEEPEST = wp.constant(-2)
"""Markers instead of the cell of a step: its rounding decides, or it is past the vertical."""


@wp.func
def body_direction(d: wp.vec3, q: wp.vec4, turn: float):
    """Return the body direction of a step that turns the world direction d upward, and its elevation [rad], world."""
    flat = wp.sqrt(d[0] * d[0] + d[1] * d[1])
    ahead = wp.vec3(d[0] / flat, d[1] / flat, 0.0)
    angle = wp.atan2(d[2], flat) + turn
    return quat_inverse_rotate(q, wp.cos(angle) * ahead + wp.vec3(0.0, 0.0, wp.sin(angle))), angle


@wp.func
def continuation(d: wp.vec3, p: wp.vec3, source: wp.vec3, below: bool, c: Params):
    """Return the point in the world direction d from p that continues the surface of `source`, and if there is one."""
    offset = source - p
    away = wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
    flat = wp.sqrt(d[0] * d[0] + d[1] * d[1])
    ahead = wp.vec3(d[0] / flat, d[1] / flat, 0.0)
    x = p + away * ahead + wp.vec3(0.0, 0.0, away * wp.tan(wp.atan2(d[2], flat)))
    depth = wp.where(below, source[2] - x[2], x[2] - source[2])
    return x, depth <= wp.where(below, c.continue_below, c.continue_above)


@functools.cache
def continue_surfaces(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that fills cells; each thread handles `tuning.cells_per_thread` neighbouring cells of a row."""
    WIDTH = wp.constant(tuning.cells_per_thread)
    Reals: Any = wp.types.vector(length=tuning.cells_per_thread, dtype=wp.float32)
    Integers: Any = wp.types.vector(length=tuning.cells_per_thread, dtype=wp.int32)

    @wp.kernel(module="unique", enable_backward=False)
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

        Below the field of view the nearest point above continues straight down, by at most continue_below. Above it,
        the nearest point below continues straight up, by at most continue_above. Filled cells are marked by `occupied`
        = 2. Workers run at the same time: a cell is filled from cells that are not. Launched over [B, groups of WIDTH
        cells / workers, rounded up].
        """
        b, i = wp.tid()
        c = params[b]
        rows = directions.shape[0]
        groups = (columns + WIDTH - 1) // WIDTH
        row = (i * workers + worker) // groups
        first = (i * workers + worker) % groups * WIDTH
        if row >= rows:
            return
        height = wp.PI / float(rows)
        elevation = (float(row) + 0.5) * height - 0.5 * wp.PI
        below = elevation < wp.radians(c.view_min) and c.continue_below > 0.0
        above = elevation > wp.radians(c.view_max) and c.continue_above > 0.0
        if not (below or above):
            return
        q = wp.normalize(quaternion[b])
        p = position[b]
        side = wp.where(below, 1.0, -1.0)
        lowest = wp.sin(wp.radians(c.view_min))
        highest = wp.sin(wp.radians(c.view_max))
        # A step turns the direction of the cell about a horizontal axis: cosine * ahead + sine * up, in the body frame.
        up = quat_inverse_rotate(q, wp.vec3(0.0, 0.0, 1.0))
        flats = Reals()
        heights = Reals()
        ahead_x = Reals()
        ahead_y = Reals()
        ahead_z = Reals()
        source_of = Integers()
        is_inside = Integers()
        inside = Integers()
        for j in range(WIDTH):
            inside[j] = _ROWS_INSIDE
        remaining = int(0)
        for j in range(wp.min(WIDTH, columns - first)):
            if occupied[b, row * columns + first + j] != 1:
                d = quat_rotate(q, directions[row, first + j])
                flat = wp.sqrt(d[0] * d[0] + d[1] * d[1])
                if flat >= 0.2:
                    ahead = quat_inverse_rotate(q, wp.vec3(d[0] / flat, d[1] / flat, 0.0))
                    flats[j] = flat
                    heights[j] = d[2]
                    ahead_x[j] = ahead[0]
                    ahead_y[j] = ahead[1]
                    ahead_z[j] = ahead[2]
                    inside[j] = 0
                    remaining += 1
        step_cosine = wp.cos(height)
        step_sine = side * wp.sin(height)
        for k in range(1, rows // 2):
            if remaining > 0:
                for j in range(WIDTH):
                    cosine = flats[j] * step_cosine - heights[j] * step_sine
                    sine = heights[j] * step_cosine + flats[j] * step_sine
                    flats[j] = cosine
                    heights[j] = sine
                    body_x = cosine * ahead_x[j] + sine * up[0]
                    body_y = cosine * ahead_y[j] + sine * up[1]
                    body_z = cosine * ahead_z[j] + sine * up[2]
                    body_flat = wp.sqrt(body_x * body_x + body_y * body_y)
                    source_row = (near_atan2(body_z, body_flat) / wp.PI + 0.5) * float(rows)
                    source_column = (near_atan2(body_y, body_x) / (2.0 * wp.PI) + 0.5) * float(columns)
                    off_center = wp.max(
                        wp.abs(source_row - wp.floor(source_row) - 0.5),
                        wp.abs(source_column - wp.floor(source_column) - 0.5),
                    )
                    source = int(wp.floor(source_row)) * columns + int(wp.floor(source_column))
                    edge = wp.min(wp.abs(body_z - lowest), wp.min(wp.abs(body_z - highest), wp.abs(cosine)))
                    source = wp.where(cosine <= 0.0, _STEEPEST, source)
                    source_of[j] = wp.where(off_center > 0.499 or edge < 1.0e-5, _UNSURE, source)
                    is_inside[j] = wp.where(body_z >= lowest and body_z <= highest, 1, 0)
                for j in range(WIDTH):
                    if inside[j] < _ROWS_INSIDE:
                        source = source_of[j]
                        if source == _UNSURE:
                            d = quat_rotate(q, directions[row, first + j])
                            body, angle = body_direction(d, q, side * float(k) * height)
                            row_of, column_of = cell_of_direction(body, rows, columns)
                            source = wp.where(wp.abs(angle) < 0.5 * wp.PI, row_of * columns + column_of, _STEEPEST)
                            is_inside[j] = wp.where(body[2] >= lowest and body[2] <= highest, 1, 0)
                        if source == _STEEPEST:
                            inside[j] = _ROWS_INSIDE
                        else:
                            inside[j] = inside[j] + is_inside[j]
                            if occupied[b, source] == 1:
                                inside[j] = _ROWS_INSIDE
                                d = quat_rotate(q, directions[row, first + j])
                                x, is_continued = continuation(d, p, filtered_points[b, source], below, c)
                                distance = wp.length(x - p)
                                if is_continued and distance <= farthest(c):
                                    cell = row * columns + first + j
                                    fine_range[b, cell] = distance
                                    filtered_points[b, cell] = x
                                    occupied[b, cell] = 2
                        if inside[j] >= _ROWS_INSIDE:
                            remaining -= 1

    return tuning.set_options(continue_surfaces, keep_loops=True)
