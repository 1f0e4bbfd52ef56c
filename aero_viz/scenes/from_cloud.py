"""A world of solids from a point cloud: ground and slopes, trunks as cylinders, walls as boxes, a mesh of the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from aero_viz.errors import UserError
from aero_viz.open3d_clouds import import_open3d, point_cloud
from aero_viz.scenes.fitted_solids import (
    FITTED_SHARE,
    Height,
    clusters,
    fit_primitive,
    mesh_triangles,
    split_trunks,
    split_walls,
)
from aero_viz.scenes.maps import check_span, complete_world, merge_voxels, occupied_voxels, recentred
from aero_viz.scenes.primitives import rotate_z
from aero_viz.scenes.solids import Solids
from aero_viz.scenes.triangles import TriangleTree
from aero_viz.scenes.world import World

TOLERANCE_RANGE = (0.01, 1.0)
"""Bounds of the tolerance [m]."""
_NEIGHBOURS, _DEVIATIONS = 20, 2.5
"""A point is an outlier if its mean distance to this many neighbours exceeds the mean by so many deviations."""
_SPACING_MAX = 0.5  # [m]; points that are farther apart belong to no surface
_GROUND_CELL = 1.0  # [m]; the lowest points of such squares are candidates for the ground
_GROUND_SLOPE = 0.7  # vertical part of the normal of the steepest slope
_GROUND_SHARE, _GROUND_PLANES = 0.05, 8  # smallest share of the squares on a plane, largest number of planes
_GROUND_THICKNESS = 1.0  # [m] of level ground
_STANDS_ON_GROUND = 0.5  # [m]; a solid that begins lower than this above the ground begins on it
_POINTS_MEASURED = 10_000
_BOTTOM = np.array([[-1, -1, -1], [1, -1, -1], [-1, 1, -1], [1, 1, -1]])  # corners of a box

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FittedWorld:
    """A world that was fitted to a cloud, and how well it fits."""

    world: World
    points: Array
    """The points that the world stands for [n, 3] [m], world frame."""
    tolerance: float
    """[m]"""
    planes: int
    """Number of planes of the ground."""
    trunks: int
    walls: int
    """Number of boxes of walls, roofs and floors, the first ones of the world."""
    mesh: int
    """Number of triangles of the rest, the first ones of the world; the others are slopes of the ground."""
    voxels: int
    """Number of boxes around points that no other solid represents, the last ones of the world."""
    outliers: int
    """Number of points that were left out."""
    median: float
    """Median distance from a point to the nearest surface [m]."""
    residual: float
    """Distance to the nearest surface within which 95 % of the points lie [m]."""

    def describe(self) -> str:
        """Return what was found in one sentence each."""
        parts = (("plane of ground", "planes of ground", self.planes), ("trunk", "trunks", self.trunks),
                 ("wall", "walls", self.walls), ("triangle", "triangles", self.mesh),
                 ("voxel", "voxels", self.voxels))  # fmt: skip
        found = ", ".join(f"{count} {one if count == 1 else many}" for one, many, count in parts)
        within = "within" if self.residual <= self.tolerance else "outside"
        return (
            f"{found}; {self.outliers} of {self.outliers + len(self.points)} points left out as outliers.\n"
            f"Points lie {self.median:.3f} m from a surface in the median, and 95 % within {self.residual:.3f} m, "
            f"{within} the tolerance of {self.tolerance:g} m."
        )


def fit_world(
    points: Array,
    path: str | Path,
    *,
    tolerance: float = 0.1,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
) -> FittedWorld:
    """Return a world of solids whose surfaces lie within a tolerance of the points.

    Outliers are removed by the distance to their neighbours, the ground is found by RANSAC among the lowest points, and
    the rest is clustered (DBSCAN). A cluster becomes a cylinder or a box if that fits; otherwise cylinders and boxes
    are taken out of it, and what remains becomes triangles. Points that even these miss become voxels. The result is
    the same in every call.

    Args:
        points: finite points [n, 3] [m], z up. Far from the origin they are moved as `load_map` does.
        path: file of the points, for messages; its stem becomes the name of the world.
        tolerance: [m]; also the edge of the voxels. About three times the noise of the points.
        start, goal: [m], [3], in the frame of the points; None chooses free places as `load_map` does.

    Raises:
        UserError: the tolerance is out of range, there are too few points, there is no free start or goal, or Open3D
            cannot be loaded.
    """
    if not TOLERANCE_RANGE[0] <= tolerance <= TOLERANCE_RANGE[1]:
        raise UserError(f"The tolerance is {tolerance!r} m; it must be in {list(TOLERANCE_RANGE)} m.")
    import_open3d().utility.random.seed(0)
    check_span(points, path)
    points, shift = recentred(points)
    dense, place = _thinned(points, 0.5 * tolerance)
    if len(dense) <= _NEIGHBOURS:
        raise UserError(
            f"{path} has {len(dense)} points that are {0.5 * tolerance:g} m apart; give a cloud of more points."
        )
    kept = np.zeros(len(dense), dtype=bool)
    kept[point_cloud(dense).remove_statistical_outlier(_NEIGHBOURS, _DEVIATIONS)[1]] = True
    spacing = min(1.5 * float(np.median(point_cloud(dense[kept]).compute_nearest_neighbor_distance())), _SPACING_MAX)
    ground = _Ground(dense[kept], tolerance)
    height = ground.height(dense)
    kept &= height > -1.5 * tolerance  # reflections
    standing = np.flatnonzero(kept & (height > 1.5 * tolerance))
    parts = clusters(dense[standing], spacing)
    kept[np.delete(standing, np.concatenate([[], *parts]).astype(int))] = False
    if not kept.any():
        raise UserError(f"{path} holds scattered points only, which lie on no surface; give a denser cloud.")
    solids = Solids()
    missed = [_fit(solids, dense[standing[part]], tolerance, spacing, ground.height) for part in parts]
    far = np.vstack([np.zeros((0, 3)), *missed])
    ground.support(solids)
    walls, mesh = len(solids.boxes), len(solids.triangles)
    ground.add_to(solids)
    voxels = merge_voxels(occupied_voxels(far, tolerance, path), tolerance) if len(far) else []
    bare = World("", np.zeros(3), np.zeros(3), mission=None, **solids.tables())
    solids.boxes += list(voxels)
    used = points[kept[place]]
    world = complete_world(path, used, solids.tables(), shift=shift, start=start, goal=goal)
    sample = used[:: max(1, len(used) // _POINTS_MEASURED)]
    measured = np.abs(bare.distance(sample))
    beyond = measured > tolerance  # only these can be nearer to one of the many voxels
    measured[beyond] = np.abs(world.distance(sample[beyond]))
    return FittedWorld(
        world, used, tolerance, planes=len(ground.planes), trunks=len(solids.cylinders), walls=walls, mesh=mesh,
        voxels=len(voxels), outliers=len(points) - len(used), median=float(np.median(measured)),
        residual=float(np.quantile(measured, FITTED_SHARE)),
    )  # fmt: skip


def _thinned(points: Array, edge: float) -> tuple[Array, NDArray[np.int64]]:
    """Return the mean of the points in every voxel that holds any [m, 3], and the row of each point in it [n]."""
    key = np.zeros(len(points), np.int64)
    for axis in range(3):  # at most 2 000 000 voxels along an axis: three indices fit into one integer
        key = (key << 21) | np.floor((points[:, axis] - points[:, axis].min()) / edge).astype(np.int64)
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(place, column) / count for column in points.T]), place


def _fit(
    solids: Solids, points: Array, tolerance: float, spacing: float, height: Height, *, is_rest: bool = False
) -> Array:
    """Add the solids of a cluster; return the points that none of them represents [n, 3].

    What remains of a cluster without its trunks and walls is not split again.
    """
    found, walls, rest = [], [], points
    whole = fit_primitive(points, tolerance, spacing, height)
    if whole is not None:
        found, rest = [whole], points[whole.distances(points) > tolerance]
    elif not is_rest:
        found, rest = split_trunks(points, tolerance, spacing)
        walls, rest = split_walls(rest, tolerance, spacing, height)
    for fit in (*found, *walls):
        getattr(solids, fit.table).append(fit.row)
    if not (found or walls):
        triangles = mesh_triangles(_thinned(points, tolerance)[0], tolerance, max(spacing, tolerance))
        solids.triangles += list(triangles)
        return points[TriangleTree(triangles).nearest(points)[0] > tolerance] if len(triangles) else points
    parts = clusters(rest, spacing)
    missed = [_fit(solids, rest[part], tolerance, spacing, height, is_rest=True) for part in parts]
    return np.vstack([*missed, np.delete(rest, np.concatenate([[], *parts]).astype(int), axis=0)])


class _Ground:
    """Planes that carry the lowest points of the squares of a grid.

    Args:
        points: points without outliers [n, 3] [m].
        tolerance: [m].
    """

    def __init__(self, points: Array, tolerance: float) -> None:
        self._tolerance = tolerance
        self._corner = np.floor(points[:, :2].min(axis=0) / _GROUND_CELL) * _GROUND_CELL
        cells = self._cells(points)
        order = np.lexsort([points[:, 2], cells[:, 1], cells[:, 0]])
        _, first, count = np.unique(cells[order] @ [2**24, 1], return_index=True, return_counts=True)
        lows = points[order[first + count // 20]]  # the lowest may be a stray one
        self.planes = list(self._find(points, lows))
        """Coefficients a, b, c of each plane z = a x + b y + c."""
        self._labels = np.full(cells.max(axis=0) + 1, -1)
        """Plane of each square, -1 for none."""
        if self.planes:
            self._label(lows)

    def _find(self, points: Array, lows: Array) -> Iterator[Array]:
        """Yield planes by RANSAC, the one of the most squares first, each refined by all points near it."""
        least = max(10, int(_GROUND_SHARE * len(lows)))
        for _ in range(_GROUND_PLANES):
            if len(lows) < least:
                return
            (a, b, c, d), _ = point_cloud(lows).segment_plane(self._tolerance, 3, 1000)
            if abs(c) < _GROUND_SLOPE:
                return
            plane: Array = -np.array([a, b, d]) / c
            around = points[np.isin(self._numbers(points), self._numbers(lows))]
            for _ in range(3):
                near = around[np.abs(around[:, 2] - _heights(around, plane)) <= self._tolerance]
                if len(near) < least:
                    return
                columns = np.column_stack([near[:, :2], np.ones(len(near))])
                plane = np.linalg.lstsq(columns, near[:, 2], rcond=None)[0].astype(np.float64)
            carried = np.abs(lows[:, 2] - _heights(lows, plane)) <= 1.5 * self._tolerance
            if carried.sum() < least:
                return
            lows = lows[~carried]
            yield plane

    def _label(self, lows: Array) -> None:
        """Give each square the plane that carries its lowest point, and others the nearest one unless it is above."""
        errors = np.abs(np.stack([lows[:, 2] - _heights(lows, plane) for plane in self.planes]))
        labels = np.where(errors.min(axis=0) <= 1.5 * self._tolerance, errors.argmin(axis=0), -1)
        cells = tuple(self._cells(lows).T)
        self._labels[cells] = labels
        nearest: Any = ndimage.distance_transform_edt(self._labels < 0, return_distances=False, return_indices=True)
        filled = self._labels[tuple(nearest)]
        above = np.ones(filled.shape, dtype=bool)
        above[cells] = lows[:, 2] > [_heights(p, self.planes[k]) for p, k in zip(lows, filled[cells], strict=True)]
        self._labels = np.where((self._labels < 0) & above, filled, self._labels)

    def height(self, points: Array) -> Array:
        """Return the height of points [n, 3] above the ground [m], infinite where there is none."""
        cells = np.clip(self._cells(points), 0, np.array(self._labels.shape) - 1)
        height, labels = np.full(len(points), np.inf), self._labels[tuple(cells.T)]
        for number, plane in enumerate(self.planes):
            mine = labels == number
            height[mine] = points[mine, 2] - _heights(points[mine], plane)
        return height

    def support(self, solids: Solids) -> None:
        """Extend the cylinders and boxes that begin a little above the ground down to it."""
        for row in solids.cylinders:
            gap = self.height(row[None, :3])[0] / row[5]
            if 0.0 < gap < _STANDS_ON_GROUND:
                row[:3] -= gap * row[3:6]
                row[7] += gap
        for row in solids.boxes:
            corners = rotate_z(0.5 * row[3:6] * _BOTTOM, np.full(4, row[6])) + row[:3]
            gaps = self.height(corners)
            gap = float(gaps[gaps < _STANDS_ON_GROUND].max(initial=0.0))
            row[2] -= 0.5 * gap
            row[5] += gap

    def add_to(self, solids: Solids) -> None:
        """Add boxes of level ground and two triangles per rectangle of a slope."""
        for number, plane in enumerate(self.planes):
            cells = np.argwhere(self._labels == number)
            for x, y, _, width, length, *_ in merge_voxels(np.pad(cells, ((0, 0), (0, 1))), _GROUND_CELL):
                centre, half = self._corner + np.array([x, y]), 0.5 * np.array([width, length])
                corners = np.array([centre + half * side for side in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
                corners = np.column_stack([corners, _heights(corners, plane)])
                if np.ptp(corners[:, 2]) <= self._tolerance:
                    middle = corners[:, 2].mean() - 0.5 * _GROUND_THICKNESS
                    solids.boxes.append(np.array([*centre, middle, width, length, _GROUND_THICKNESS, 0.0]))
                else:
                    solids.triangles += [corners[[0, 1, 2]].ravel(), corners[[0, 2, 3]].ravel()]

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.floor((points[:, :2] - self._corner) / _GROUND_CELL).astype(np.int64)

    def _numbers(self, points: Array) -> NDArray[np.int64]:
        return self._cells(points) @ [2**24, 1]


def _heights(points: Array, plane: Array) -> Array:
    """Return the height of a plane [m] at points [.., 2 or 3]."""
    return points[..., :2] @ plane[:2] + plane[2]
