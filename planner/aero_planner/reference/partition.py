"""Spherical partition of the cloud in the body frame: fine cells of 3 deg, coarse cells of 18 deg, filtered cloud.

Row 0 points straight down, column 0 backward (azimuth -180 deg).
"""

from __future__ import annotations

import warp as wp

from aero_planner.reference.dynamics import State, rotation
from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})

COARSE_ROWS = wp.constant(10)
COARSE_COLUMNS = wp.constant(20)
EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
"""Key of a cell without a point."""
SAME_COSINE = wp.constant(1.0e-6)
"""Difference between the cosines of directions that count as equal."""


@wp.func
def cell_of(d: wp.vec3, rows: int, columns: int):
    """Return the row and the column of the cell that contains the direction d."""
    azimuth = wp.atan2(d[1], d[0])
    elevation = wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
    row = int(wp.floor(elevation * (float(rows) / wp.PI) + 0.5 * float(rows)))
    column = int(wp.floor(azimuth * (0.5 * float(columns) / wp.PI) + 0.5 * float(columns)))
    return wp.clamp(row, 0, rows - 1), (column + columns) % columns


@wp.func
def cell_direction(i: int, j: int, rows: int, columns: int) -> wp.vec3:
    """Return d_ij = (cos b cos a, cos b sin a, sin b), with azimuth a and elevation b of the cell's centre."""
    a = ((float(j) + 0.5) / float(columns) - 0.5) * 2.0 * wp.PI
    b = ((float(i) + 0.5) / float(rows) - 0.5) * wp.PI
    return wp.vec3(wp.cos(b) * wp.cos(a), wp.cos(b) * wp.sin(a), wp.sin(b))


@wp.kernel
def clear_cells(keys: wp.array2d(dtype=wp.uint64), dropped: wp.array(dtype=int)):
    """Empty the cells. Launched over [F0, F1]."""
    i, j = wp.tid()
    keys[i, j] = EMPTY
    dropped[0] = 0


@wp.kernel
def find_nearest_points(
    x0: State, c: Parameters, points: wp.array(dtype=wp.vec3), keys: wp.array2d(dtype=wp.uint64),
    dropped: wp.array(dtype=int),
):  # fmt: skip
    """Find the nearest point within r_max of each fine cell. Launched over [P].

    A key is the bits of the range, which have the order of the ranges, then the index of the point.
    """
    n = wp.tid()
    if not wp.isfinite(points[n]):
        wp.atomic_add(dropped, 0, 1)
        return
    offset = points[n] - x0.p
    r = wp.length(offset)
    if r <= c.r_max:
        i, j = cell_of(wp.transpose(rotation(x0.q)) * offset, keys.shape[0], keys.shape[1])
        wp.atomic_min(keys, i, j, (wp.uint64(wp.cast(r, wp.uint32)) << wp.uint64(32)) | wp.uint64(n))


@wp.kernel
def fine_partition(
    c: Parameters, points: wp.array(dtype=wp.vec3), keys: wp.array2d(dtype=wp.uint64),
    fine_range: wp.array2d(dtype=float), filtered: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Write r_ij, the nearest range of a cell or r_max, and the filtered cloud. Launched over [F0, F1].

    The filtered cloud keeps the nearest point itself; the point of an empty cell is infinitely far away.
    """
    i, j = wp.tid()
    fine_range[i, j] = c.r_max
    filtered[i, j] = wp.vec3(wp.INF, wp.INF, wp.INF)
    if keys[i, j] != EMPTY:
        fine_range[i, j] = wp.cast(wp.uint32(keys[i, j] >> wp.uint64(32)), float)
        filtered[i, j] = points[int(keys[i, j] & wp.uint64(0xFFFFFFFF))]


@wp.func
def safe_cell(row: int, column: int, toward: wp.vec3, fine_range: wp.array2d(dtype=float)):
    """Return r_ij and d_ij of the fine cell with the largest range in a coarse cell: max r_ij.

    Of cells with the same range it is that nearest to the direction `toward`, and the first of equally near ones.
    """
    pool = fine_range.shape[0] // COARSE_ROWS
    r_best = float(-1.0)
    cosine_best = float(-2.0)
    d_best = wp.vec3(0.0, 0.0, 0.0)
    for i in range(row * pool, (row + 1) * pool):
        for j in range(column * pool, (column + 1) * pool):
            r = fine_range[i, j]
            d = cell_direction(i, j, fine_range.shape[0], fine_range.shape[1])
            cosine = wp.dot(d, toward)
            if r > r_best or (r == r_best and cosine > cosine_best + SAME_COSINE):
                r_best = r
                cosine_best = cosine
                d_best = d
    return r_best, d_best


@wp.kernel
def coarse_partition(
    directions: wp.array(dtype=wp.vec3), fine_range: wp.array2d(dtype=float),
    safe_range: wp.array2d(dtype=float), safe_direction: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Pool the fine cells of each coarse cell. Launched over [C0, C1].

    Ties go toward the first of the anchors' `directions` in the cell, or toward its centre.
    """
    row, column = wp.tid()
    toward = cell_direction(row, column, COARSE_ROWS, COARSE_COLUMNS)
    found = bool(False)
    for m in range(directions.shape[0]):
        i, j = cell_of(directions[m], COARSE_ROWS, COARSE_COLUMNS)
        if i == row and j == column and not found:
            toward = directions[m]
            found = True
    r, d = safe_cell(row, column, toward, fine_range)
    safe_range[row, column] = r
    safe_direction[row, column] = d
