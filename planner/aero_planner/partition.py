"""Spherical partition of the cloud: fine ranges, coarse safe directions, filtered cloud.

A direction d = (cos b cos a, cos b sin a, sin b) with azimuth a and elevation b in the body frame. Fine cells have
equal angles; row 0 looks straight down, column 0 backward (a = -180 deg). Coarse cells pool fine_cells x fine_cells of
them.
"""

from __future__ import annotations

import warp as wp

from aero_planner.dynamics import quat_inverse_rotate
from aero_planner.params import Params

__all__ = ["EMPTY", "cell_direction", "cell_of_direction", "finish_fine", "pool_coarse", "scatter_points"]

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Key of a fine cell without a point."""


@wp.func
def approximate_atan2(y: float, x: float) -> float:
    """Angle of (x, y) [rad] within 2e-5, several times faster than atan2 on a CPU."""
    low = wp.min(wp.abs(x), wp.abs(y))
    high = wp.max(wp.abs(x), wp.abs(y))
    t = low / wp.max(high, 1.0e-30)
    s = t * t
    # Minimax polynomial of atan on [0, 1].
    angle = t * (
        0.99997726 + s * (-0.33262347 + s * (0.19354346 + s * (-0.11643287 + s * (0.05265332 - s * 0.01172120))))
    )
    angle = wp.where(wp.abs(y) > wp.abs(x), 0.5 * wp.PI - angle, angle)
    angle = wp.where(x < 0.0, wp.PI - angle, angle)
    return wp.where(y < 0.0, -angle, angle)


@wp.func
def angle_cell(y: float, x: float, cells_per_radian: float, offset: float) -> int:
    """floor(atan2(y, x) cells_per_radian + offset), exactly: the approximation decides only away from an edge."""
    # Never negative but for the approximation's error, so that int() is floor().
    coordinate = approximate_atan2(y, x) * cells_per_radian + offset
    cell = int(coordinate)
    if wp.abs(coordinate - float(cell) - 0.5) > 0.5 - 1.0e-4 * cells_per_radian:
        cell = int(wp.floor(wp.atan2(y, x) * cells_per_radian + offset))
    return cell


@wp.func
def cell_of_direction(d: wp.vec3, rows: int, columns: int):
    """Row and column of the cell that holds the direction d, which need not be a unit vector."""
    horizontal = wp.sqrt(d[0] * d[0] + d[1] * d[1])
    row = angle_cell(d[2], horizontal, float(rows) / wp.PI, 0.5 * float(rows))
    column = angle_cell(d[1], d[0], 0.5 * float(columns) / wp.PI, 0.5 * float(columns))
    # a = +180 deg is a = -180 deg, b = +90 deg belongs to the uppermost row.
    return wp.clamp(row, 0, rows - 1), (column + columns) % columns


@wp.func
def cell_direction(row: int, column: int, rows: int, columns: int) -> wp.vec3:
    """Unit direction of a cell's centre."""
    azimuth = ((float(column) + 0.5) / float(columns) - 0.5) * 2.0 * wp.PI
    elevation = ((float(row) + 0.5) / float(rows) - 0.5) * wp.PI
    c = wp.cos(elevation)
    return wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))


@wp.kernel
def scatter_points(
    first: int,
    lane: int,
    points: wp.array2d(dtype=wp.vec3),
    point_count: wp.array(dtype=int),
    position: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    rows: int,
    columns: int,
    keys: wp.array3d(dtype=wp.uint64),
    dropped: wp.array2d(dtype=int),
):
    """r_ij as a minimum over packed keys: range above, the point's index below, so that equal ranges take the first
    point.

    Launched over [B, points of this lane]; lanes run at the same time on keys of their own.
    """
    b, offset = wp.tid()
    i = first + offset
    if i >= point_count[b]:
        return
    x = points[b, i]
    d = x - position[b]
    r = wp.length(d)
    # NaN compares false, so that only what is out of range has to be looked at closely.
    if not (r <= params[b].range_max and r >= params[b].range_min):
        if not (wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])):
            wp.atomic_add(dropped, lane, b, 1)
        return
    row, column = cell_of_direction(quat_inverse_rotate(quaternion[b], d), rows, columns)
    # The bits of a non-negative float sort like the float.
    key = (wp.uint64(wp.cast(r, wp.uint32)) << wp.uint64(32)) | wp.uint64(i)
    wp.atomic_min(keys, lane, b, row * columns + column, key)


@wp.kernel
def finish_fine(
    keys: wp.array3d(dtype=wp.uint64),
    points: wp.array2d(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    fine_range: wp.array2d(dtype=float),
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
):
    """Ranges and filtered cloud from the keys of all lanes, which are emptied for the next plan. Launched over [B,
    cells]."""
    b, cell = wp.tid()
    key = EMPTY
    for lane in range(keys.shape[0]):
        key = wp.min(key, keys[lane, b, cell])
        keys[lane, b, cell] = EMPTY
    if key == EMPTY:
        fine_range[b, cell] = params[b].range_max
        occupied[b, cell] = 0
    else:
        fine_range[b, cell] = wp.cast(wp.uint32(key >> wp.uint64(32)), float)
        occupied[b, cell] = 1
        filtered[b, cell] = points[b, int(key & wp.uint64(0xFFFFFFFF))]


@wp.func
def safest_fine_cell(
    fine_range: wp.array2d(dtype=float),
    b: int,
    coarse_row: int,
    coarse_column: int,
    pool: int,
    coarse_rows: int,
    coarse_columns: int,
    toward: wp.vec3,
):
    """Largest range in a coarse cell and its direction; among equal ranges the direction nearest to `toward`."""
    rows = coarse_rows * pool
    columns = coarse_columns * pool
    best_range = float(-1.0)
    best_cosine = float(-2.0)
    best_direction = wp.vec3(1.0, 0.0, 0.0)
    for i in range(pool):
        for j in range(pool):
            row = coarse_row * pool + i
            column = coarse_column * pool + j
            r = fine_range[b, row * columns + column]
            if r >= best_range:
                d = cell_direction(row, column, rows, columns)
                cosine = wp.dot(d, toward)
                # The margin lets the first of several equally near cells win, whatever the rounding.
                if r > best_range or cosine > best_cosine + 1.0e-6:
                    best_range = r
                    best_cosine = cosine
                    best_direction = d
    return best_range, best_direction


@wp.kernel
def pool_coarse(
    fine_range: wp.array2d(dtype=float),
    initial_direction: wp.array2d(dtype=wp.vec3),
    anchor_count: int,
    pool: int,
    coarse_rows: int,
    coarse_columns: int,
    safe_range: wp.array2d(dtype=float),
    safe_direction: wp.array2d(dtype=wp.vec3),
):
    """Safe range and direction of each coarse cell. Launched over [B, coarse cells].

    Equal ranges are decided toward the first anchor in the cell, else toward the cell's centre.
    """
    b, cell = wp.tid()
    coarse_row = cell // coarse_columns
    coarse_column = cell % coarse_columns
    toward = cell_direction(coarse_row, coarse_column, coarse_rows, coarse_columns)
    for reverse in range(anchor_count):
        d = initial_direction[b, anchor_count - 1 - reverse]
        row, column = cell_of_direction(d, coarse_rows, coarse_columns)
        if row == coarse_row and column == coarse_column:
            toward = d
    best_range, best_direction = safest_fine_cell(
        fine_range, b, coarse_row, coarse_column, pool, coarse_rows, coarse_columns, toward
    )
    safe_range[b, cell] = best_range
    safe_direction[b, cell] = best_direction
