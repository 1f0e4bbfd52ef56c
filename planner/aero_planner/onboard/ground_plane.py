"""The height of the ground below the drone, from LiDAR points that need not lie below it.

A Mid-360 looks 7 degrees down: from a height of 2 m it sees the ground only beyond 16 m. A plane through patches of
ground on all sides gives the height of the ground in the middle. An error of the attitude lifts the ground on one side
and lowers it on the other, and so hardly matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RADIUS = 38.0  # [m] within which points are used
_CELL = 1.0  # [m] edge of a square cell
_DEPTH = 0.3  # [m] that ground lies below the drone at least
_FLAT = 0.2  # [m] height of the layer of points in a cell that may be ground
_CLEAR = 1.0  # [m] of free space above this layer; the foot of a trunk has none
_CELL_POINTS = 3
_SECTORS, _MIN_SECTORS = 12, 8  # sectors around the drone, and how many of them must hold ground
_MIN_CELLS = 20
_TOLERANCE = 0.2  # [m] from the plane
_MIN_INLIERS = 0.6  # fraction of the cells
_MAX_SLOPE = 0.27  # 15 deg
_MAX_POINTS = 30_000
_ROUNDS = 6


def find_ground(points: NDArray[np.float32], position: NDArray[np.float64]) -> float | None:
    """Return the height of the ground at the drone's place, world frame [m]; None unless it is clearly visible.

    Cells that hold a thin layer of points with free space above it are patches of ground. They must lie in at least two
    thirds of all directions and in one plane.

    Args:
        points: Cloud [m], shape [P, 3], world frame.
        position: Position of the drone [m], shape [3].
    """
    cells = _find_flat_cells(points, position)
    if len(cells) < _MIN_CELLS:
        return None
    plane = _fit_plane(cells)
    is_near = np.abs(cells @ [-plane[0], -plane[1], 1.0] - plane[2]) <= _TOLERANCE
    inliers = cells[is_near]
    sectors = np.unique(np.floor(np.arctan2(inliers[:, 1], inliers[:, 0]) / (2.0 * np.pi) * _SECTORS))
    is_clear = is_near.mean() >= _MIN_INLIERS and len(sectors) >= _MIN_SECTORS and np.hypot(*plane[:2]) <= _MAX_SLOPE
    height = float(position[2] + plane[2])
    return height if is_clear and plane[2] < -_DEPTH else None


def _find_flat_cells(points: NDArray[np.float32], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centres of patches that may be ground [m], shape [n, 3], relative to the drone."""
    relative = points[:: len(points) // _MAX_POINTS + 1] - position.astype(np.float32)
    is_used = (np.hypot(relative[:, 0], relative[:, 1]) < _RADIUS) & (relative[:, 2] < _CLEAR)
    relative = relative[is_used].astype(np.float64)
    if len(relative) == 0:
        return np.zeros((0, 3))
    size = 2 * int(_RADIUS / _CELL) + 2
    column, row = np.floor(relative[:, :2] / _CELL).astype(int).T + size // 2
    order = np.lexsort((relative[:, 2], column * size + row))
    relative, key = relative[order], (column * size + row)[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))  # the lowest point of each cell
    cell = np.repeat(np.arange(len(first)), np.diff(first, append=len(key)))
    above = relative[:, 2] - relative[first, 2][cell]
    in_layer = above <= _FLAT
    count = np.bincount(cell[in_layer], minlength=len(first))
    blocked = np.bincount(cell[(above > _FLAT) & (above <= _FLAT + _CLEAR)], minlength=len(first))
    sums = np.stack([np.bincount(cell[in_layer], relative[in_layer, k], len(first)) for k in range(3)], axis=1)
    is_flat = (count >= _CELL_POINTS) & (blocked == 0)
    centres = (sums[is_flat] / count[is_flat, None]).astype(np.float64)
    return centres[centres[:, 2] < -_DEPTH]


def _fit_plane(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a, b, c of the plane z = a x + b y + c, fitted with decreasing weight for cells off the plane."""
    design = np.column_stack([cells[:, :2], np.ones(len(cells))])
    plane = np.array([0.0, 0.0, float(np.median(cells[:, 2]))])
    for _ in range(_ROUNDS):
        error = cells[:, 2] - design @ plane
        weight = 1.0 / (1.0 + (error / _TOLERANCE) ** 2)
        plane = np.linalg.lstsq(design * weight[:, None], cells[:, 2] * weight, rcond=None)[0].astype(np.float64)
    return plane
