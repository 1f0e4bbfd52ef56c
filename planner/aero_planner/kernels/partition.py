"""Spherical partition of the cloud: fine ranges, coarse safe directions, filtered cloud.

A direction d = (cos b cos a, cos b sin a, sin b) with azimuth a and elevation b in the body frame. Fine cells have
equal angles; row 0 looks straight down, column 0 backward (a = -180 deg). Coarse cells pool fine_cells x fine_cells of
them.
"""

from __future__ import annotations

import functools

import warp as wp

from aero_planner.kernels.dynamics import near_atan2, quat_rotate
from aero_planner.kernels.kernel_tuning import Widths, add_count
from aero_planner.kernels.params import Params

__all__ = [
    "EMPTY",
    "cell_direction",
    "cell_of_direction",
    "fill_directions",
    "finish_fine",
    "pool_coarse",
    "safest_fine_cell",
    "scatter_points",
]

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Key of a fine cell without a point."""


@wp.func
def cell_of_direction(d: wp.vec3, rows: int, columns: int):
    """Row and column of the cell that holds the direction d, which need not be a unit vector."""
    azimuth = wp.atan2(d[1], d[0])
    elevation = wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
    row = int(wp.floor(elevation * (float(rows) / wp.PI) + 0.5 * float(rows)))
    column = int(wp.floor(azimuth * (0.5 * float(columns) / wp.PI) + 0.5 * float(columns)))
    # a = +180 deg is a = -180 deg, b = +90 deg belongs to the uppermost row.
    return wp.clamp(row, 0, rows - 1), (column + columns) % columns


@wp.func
def cell_direction(row: int, column: int, rows: int, columns: int) -> wp.vec3:
    """Unit direction of a cell's centre."""
    azimuth = ((float(column) + 0.5) / float(columns) - 0.5) * 2.0 * wp.PI
    elevation = ((float(row) + 0.5) / float(rows) - 0.5) * wp.PI
    c = wp.cos(elevation)
    return wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))


NEAR_EDGE = wp.constant(-1)
OUT_OF_RANGE = wp.constant(-2)
NOT_FINITE = wp.constant(-3)
"""What `scatter_points` notes in place of a cell."""


@functools.cache
def scatter_points(of: Widths) -> wp.Kernel:
    """Return the kernel that finds r_ij.

    A CPU computes the cells of many points at once, with the same instructions, if they are in one thread; a GPU has a
    thread for each.
    """
    WIDTH = wp.constant(of.cloud)
    Reals = wp.types.vector(length=of.cloud, dtype=wp.float32)
    Integers = wp.types.vector(length=of.cloud, dtype=wp.int32)

    @wp.kernel(module="unique", enable_backward=False)
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
        """r_ij as a minimum over packed keys: range above, the point's index below, so that equal ranges take the
        first point.

        Launched over [B, points of this lane / of.cloud]; lanes run at the same time on keys of their own.
        """
        b, group = wp.tid()
        start = first + group * WIDTH
        count = wp.min(WIDTH, point_count[b] - start)
        if count <= 0:
            return
        origin = position[b]
        q = wp.normalize(quaternion[b])
        forward = quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
        left = quat_rotate(q, wp.vec3(0.0, 1.0, 0.0))
        up = quat_rotate(q, wp.vec3(0.0, 0.0, 1.0))
        range_min = params[b].range_min
        range_max = params[b].range_max
        dx = Reals()
        dy = Reals()
        dz = Reals()
        for j in range(count):
            d = points[b, start + j] - origin
            dx[j] = d[0]
            dy[j] = d[1]
            dz[j] = d[2]
        range_bits = Integers()
        cell_of = Integers()
        for j in range(WIDTH):
            d = wp.vec3(dx[j], dy[j], dz[j])
            x = wp.dot(forward, d)
            y = wp.dot(left, d)
            z = wp.dot(up, d)
            r = wp.sqrt(wp.dot(d, d))
            row = (near_atan2(z, wp.sqrt(x * x + y * y)) / wp.PI + 0.5) * float(rows)
            column = (near_atan2(y, x) / (2.0 * wp.PI) + 0.5) * float(columns)
            off_center = wp.max(wp.abs(row - wp.floor(row) - 0.5), wp.abs(column - wp.floor(column) - 0.5))
            cell = int(wp.floor(row)) * columns + int(wp.floor(column))
            cell = wp.where(off_center > 0.4999, NEAR_EDGE, cell)
            cell = wp.where(r >= range_min, wp.where(r <= range_max, cell, OUT_OF_RANGE), OUT_OF_RANGE)
            # d - d is NaN for what is not finite, even where the squared range alone is not.
            cell_of[j] = wp.where((d[0] - d[0]) + (d[1] - d[1]) + (d[2] - d[2]) == 0.0, cell, NOT_FINITE)
            range_bits[j] = wp.cast(r, wp.int32)
        not_finite = int(0)
        for j in range(count):
            cell = cell_of[j]
            if cell >= NEAR_EDGE:
                if cell == NEAR_EDGE:
                    d = wp.vec3(dx[j], dy[j], dz[j])
                    body = wp.vec3(wp.dot(forward, d), wp.dot(left, d), wp.dot(up, d))
                    row_of, column_of = cell_of_direction(body, rows, columns)
                    cell = row_of * columns + column_of
                # The bits of a non-negative float sort like the float.
                key = (wp.uint64(wp.uint32(range_bits[j])) << wp.uint64(32)) | wp.uint64(start + j)
                if key < keys[lane, b, cell]:
                    wp.atomic_min(keys, lane, b, cell, key)
            elif cell == NOT_FINITE:
                not_finite += 1
        add_count(dropped, lane, b, not_finite)

    return scatter_points


@wp.kernel
def finish_fine(
    keys: wp.array3d(dtype=wp.uint64),
    dropped_of_lane: wp.array2d(dtype=int),
    points: wp.array2d(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    fine_range: wp.array2d(dtype=float),
    occupied: wp.array2d(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    dropped: wp.array(dtype=int),
):
    """Ranges, filtered cloud and number of dropped points from the keys and counters of all lanes, which are emptied
    for the next plan. Launched over [B, cells]."""
    b, cell = wp.tid()
    if cell == 0:
        count = int(0)
        for lane in range(keys.shape[0]):
            count += dropped_of_lane[lane, b]
            dropped_of_lane[lane, b] = 0
        dropped[b] = count
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


@wp.kernel
def fill_directions(directions: wp.array2d(dtype=wp.vec3)):
    """Directions of all cells. Launched over [rows, columns]."""
    row, column = wp.tid()
    directions[row, column] = cell_direction(row, column, directions.shape[0], directions.shape[1])


SIDE = wp.constant(6)
"""Fine cells that are read at a time."""

Side = wp.types.vector(length=6, dtype=wp.float32)


@wp.func
def safest_fine_cell(
    fine_range: wp.array2d(dtype=float),
    directions: wp.array2d(dtype=wp.vec3),
    b: int,
    coarse_row: int,
    coarse_column: int,
    pool: int,
    toward: wp.vec3,
):
    """Largest range in a coarse cell and its direction; among equal ranges the direction nearest to `toward`."""
    columns = directions.shape[1]
    best_range = float(-1.0)
    best_cosine = float(-2.0)
    best_direction = wp.vec3(1.0, 0.0, 0.0)
    r = Side()
    cosine = Side()
    for i in range(pool):
        row = coarse_row * pool + i
        # Some at a time are read, so that a GPU waits for memory once; the last one again changes nothing.
        for j in range(0, pool, SIDE):
            first = coarse_column * pool + j
            last = (coarse_column + 1) * pool - 1
            for k in range(SIDE):
                column = wp.min(first + k, last)
                r[k] = fine_range[b, row * columns + column]
                cosine[k] = wp.dot(directions[row, column], toward)
            for k in range(SIDE):
                # The margin lets the first of several equally near cells win, whatever the rounding.
                if r[k] > best_range or (r[k] == best_range and cosine[k] > best_cosine + 1.0e-6):
                    best_range = r[k]
                    best_cosine = cosine[k]
                    best_direction = directions[row, wp.min(first + k, last)]
    return best_range, best_direction


@wp.kernel
def pool_coarse(
    fine_range: wp.array2d(dtype=float),
    directions: wp.array2d(dtype=wp.vec3),
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
    best_range, best_direction = safest_fine_cell(fine_range, directions, b, coarse_row, coarse_column, pool, toward)
    safe_range[b, cell] = best_range
    safe_direction[b, cell] = best_direction
