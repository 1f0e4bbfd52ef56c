"""Worlds from maps of points, occupied voxels as boxes, and from meshes; a start and a goal where there is room."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.errors import UserError
from aero_viz.scenes.map_files import read_mesh, read_points
from aero_viz.scenes.world import World

__all__ = ["map_world"]

VOXEL, VOXELS = 0.2, (0.01, 100.0)
"""Edge of a voxel where nothing is said, and what it may be [m]."""
HEIGHT = 2.0
"""Of a start and a goal that are not given, over the local ground [m]."""
ROOM = 0.75
"""Their least distance to an obstacle [m]."""
WAY = 0.5
"""Radius of the drone that can fly from such a start to such a goal [m]."""
DISTANCE = 45.0
"""Such a goal is no farther from the start than this [m]."""
_FAR = 10_000.0  # [m]; beyond, float32 has millimetres left
_TILE = 4.0  # [m]; the local ground is the low end of the points in a square of this edge
_CELL = 0.5  # [m] of the search for a start and a goal ..
_CELLS = 400  # .. or so many cells along the map
_SAMPLES = 100_000  # points on a mesh, about one per square metre or so many
_WIDE = 1.5  # [m]; wider is no better for a start

Array = NDArray[np.float64]


def map_world(
    path: str | Path, *, voxel: float | None = None, start: ArrayLike | None = None, goal: ArrayLike | None = None
) -> World:
    """Return a world of boxes, the occupied voxels of a map, or of the triangles of a mesh; see `World.from_map`."""
    triangles = read_mesh(path)
    if len(triangles) and voxel is not None:
        raise UserError(f"{path} is a mesh, which has no voxels; leave their size out.")
    edge = VOXEL if voxel is None else voxel
    if not VOXELS[0] <= edge <= VOXELS[1]:
        raise UserError(f"The voxels of the map {path} have an edge of {edge!r} m; it must be in {list(VOXELS)} m.")
    points = _sample(triangles) if len(triangles) else read_points(path)
    # A map in geographic coordinates moves to the origin.
    shift = np.floor(points.min(axis=0)) if np.abs(points).max() > _FAR else np.zeros(3)
    points = points - shift
    first = None if start is None else _position(start, "start") - shift
    last = None if goal is None else _position(goal, "goal") - shift
    tables: dict[str, Array] = {}
    if len(triangles):
        tables["triangles"] = triangles - np.tile(shift, 3)
    else:
        tables["boxes"] = _merge(np.unique(np.floor(points / edge).astype(np.int64), axis=0), edge)
    try:
        if first is None or last is None:
            first, last = _find_ends(points, tables, first, last, where=path)
        return World(Path(path).stem, first, last, **tables)
    except ValueError as error:
        raise UserError(f"The map {path} makes no world: {error}") from error


def _position(value: ArrayLike, name: str) -> Array:
    position = np.array(value, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise UserError(f"The {name} {np.asarray(value).tolist()} is no position; give three finite numbers.")
    return position


def _merge(voxels: NDArray[np.int64], edge: float) -> Array:
    """Return boxes [n, 7] that together fill the voxels [m, 3] exactly: runs along x, of runs along y, of runs along z.

    A wall or floor takes a tenth of the boxes then; rays, distances and drawings gain as much.
    """
    low, high = voxels, voxels + 1
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        # Equal in both other axes: sorted next to each other, in order along this one.
        keys = [low[:, axis], *(side[:, i] for i in others for side in (low, high))]
        order = np.lexsort(keys)
        low, high = low[order], high[order]
        follows = (low[1:, axis] == high[:-1, axis]) & np.all(low[1:, others] == low[:-1, others], axis=1)
        follows &= np.all(high[1:, others] == high[:-1, others], axis=1)
        first = np.concatenate([[True], ~follows])
        last = np.concatenate([~follows, [True]])
        low, high = low[first], high[last]
    rows = np.column_stack([0.5 * edge * (low + high), edge * (high - low), np.zeros(len(low))])
    return rows.astype(np.float64)


def _sample(triangles: Array) -> Array:
    """Return points on triangles [n, 9], dense enough to tell the height of the ground in each tile: [m, 3].

    What looks down is left out where something looks up: the underside of a floor is no ground.
    """
    a, b, c = np.split(triangles, 3, axis=1)
    normal = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(normal, axis=1)
    upward = normal[:, 2] > -area
    if upward.any() and not upward.all():
        return _sample(triangles[upward])
    count = np.ceil(np.minimum(area, area * _SAMPLES / max(area.sum(), 1.0))).astype(int)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(size=(2, int(count.sum()), 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (np.repeat(corner, count, axis=0) for corner in (a, b, c))
    return np.vstack([triangles.reshape(-1, 3), a + u * (b - a) + v * (c - a)])


def _find_ends(
    points: Array, tables: dict[str, Array], start: Array | None, goal: Array | None, *, where: str | Path
) -> tuple[Array, Array]:
    """Choose what is None of start and goal, see `World.from_map`."""
    from aero_viz.scenes.passable import ClearanceGrid

    lower, upper = points.min(axis=0), points.max(axis=0)
    cell = max(_CELL, float((upper - lower).max()) / _CELLS)
    # The world's start only anchors the grid here.
    anchor = np.rint(0.5 * (lower + upper)) if start is None else start
    world = World("", anchor, anchor if goal is None else goal, **tables)
    grid = ClearanceGrid.of(
        world, cell=cell, reach=_WIDE, band=(lower[2], upper[2] + HEIGHT), region=[lower[:2], upper[:2]]
    )
    index = np.moveaxis(np.indices(grid.distance.shape), 0, -1)
    places = grid.corner + cell * index
    over_ground = places[..., 2] - _ground(points, places[:, :, 0, :2])[..., None]
    free = (grid.distance >= ROOM) & (np.abs(over_ground - HEIGHT) <= 0.5 * cell + 1e-9)
    inside = np.all((lower[:2] <= 0.0) & (upper[:2] >= 0.0))
    origin = np.zeros(2) if inside else 0.5 * (lower + upper)[:2]
    if start is None:
        near = origin if goal is None else goal[:2]
        away = np.linalg.norm(places[..., :2] - near, axis=-1)
        if goal is not None:
            away = np.abs(away - DISTANCE)
        start = _best(places, free, grid.distance - 0.05 * away, "start", where)
    if goal is None:
        reached = grid.reached(start, threshold=math.hypot(WAY, 0.5 * cell))
        away = np.linalg.norm(places - start, axis=-1)
        goal = _best(places, free & reached & (away <= DISTANCE), away, "goal", where)
    return start, goal


def _best(places: Array, allowed: NDArray[np.bool_], score: Array, what: str, where: str | Path) -> Array:
    if not allowed.any():
        raise UserError(
            f"The map {where} has no free place {HEIGHT:g} m over its ground for the {what}; give start and goal."
        )
    return places[np.unravel_index(np.argmax(np.where(allowed, score, -np.inf)), score.shape)]


def _ground(points: Array, places: Array) -> Array:
    """Return the height of the ground below `places` [X, Y, 2], shape [X, Y] [m]: the fifth percentile of z in each
    square of 4 m, and of all points where a square has none."""
    lower = points[:, :2].min(axis=0)
    tiles = np.floor((points[:, :2] - lower) / _TILE).astype(int)
    shape = np.maximum(tiles.max(axis=0), np.floor((places.max(axis=(0, 1)) - lower) / _TILE).astype(int)) + 1
    height = np.full(shape, np.percentile(points[:, 2], 5))
    key = tiles[:, 0] * shape[1] + tiles[:, 1]
    order = np.lexsort([points[:, 2], key])
    present, first, count = np.unique(key[order], return_index=True, return_counts=True)
    height.ravel()[present] = points[order, 2][first + count // 20]
    at = np.clip(np.floor((places - lower) / _TILE).astype(int), 0, shape - 1)
    return height[at[..., 0], at[..., 1]]
