"""Spherical partition of the cloud: fine ranges, coarse safe directions, filtered cloud.

A direction d = (cos b cos a, cos b sin a, sin b) with azimuth a and elevation b in the body frame. Fine cells have
equal angles; row 0 looks straight down, column 0 backward (a = -180 deg). Coarse cells pool fine_cells x fine_cells of
them.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.dynamics import quat_inverse_rotate
from aero_planner.params import Params

__all__ = [
    "EMPTY",
    "cell_direction",
    "cell_of_direction",
    "direction_tables",
    "finish_fine",
    "pool_coarse",
    "safest_fine_cell",
    "scatter_points",
]

wp.set_module_options({"enable_backward": False})

BINS = wp.constant(8192)
"""Bins of each table of `look_up_cell`."""

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
def look_up_cell(d: wp.vec3, r: float, rows: int, columns: int, tables: wp.array2d(dtype=wp.int16)):
    """`cell_of_direction` of d = r times a unit vector, by `direction_tables`: several times faster on a CPU.

    The row follows from the sine z / r, the column from y / (|x| + |y|), which grows with the azimuth. A table's bin
    that an edge between cells runs through is marked, and there the angles decide.
    """
    sine = d[2] / wp.max(r, 1.0e-30)
    turn = d[1] / wp.max(wp.abs(d[0]) + wp.abs(d[1]), 1.0e-30)
    turn = wp.where(d[0] < 0.0, 2.0 - turn, turn)
    row = int(tables[0, int((sine + 1.0) * (0.5 * float(BINS)))])
    column = int(tables[1, int((turn + 1.0) * (0.25 * float(BINS)))])
    if row < 0 or column < 0:
        row, column = cell_of_direction(d, rows, columns)
    return row, column


def direction_tables(rows: int, columns: int) -> NDArray[np.int16]:
    """Return the tables of `look_up_cell`, shape [2, BINS + 1]: the row by the sine of the elevation in [-1, 1], and
    the column by the turn in [-1, 3], which is y / (|x| + |y|) in front and 2 minus that behind; -1 where an edge runs
    through the bin."""
    margin = 1e-3  # of a bin; float32 places a direction within a thousandth of that
    low, high = np.arange(BINS + 1) - margin, np.arange(BINS + 1) + 1 + margin

    def row(at: NDArray[np.float64]) -> NDArray[np.float64]:
        elevation = np.arcsin(np.clip(at * 2.0 / BINS - 1.0, -1.0, 1.0))
        return np.clip(np.floor((elevation / np.pi + 0.5) * rows), 0, rows - 1)

    def column(at: NDArray[np.float64]) -> NDArray[np.float64]:
        turn = at * 4.0 / BINS - 1.0
        behind = turn > 1.0
        y = np.where(behind, 2.0 - turn, turn)
        azimuth = np.arctan2(y, np.where(behind, -1.0, 1.0) * (1.0 - np.abs(y)))
        return np.floor((azimuth / (2.0 * np.pi) + 0.5) * columns) % columns

    return np.stack([np.where(cell(low) == cell(high), cell(low), -1) for cell in (row, column)]).astype(np.int16)


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
    tables: wp.array2d(dtype=wp.int16),
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
    row, column = look_up_cell(quat_inverse_rotate(quaternion[b], d), r, rows, columns, tables)
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
