"""Worlds from files: voxels of a point map as boxes, the triangles of a mesh, or solids; free starts and goals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.errors import UserError
from aero_viz.input_limits import MAP_CELLS_MAX, MAP_SPAN_MAX, MAP_VOXELS_MAX
from aero_viz.scenes.decoder_checks import check_place
from aero_viz.scenes.map_files import SOLID_SUFFIXES, read_map, read_solids
from aero_viz.scenes.primitives import primitive_bounds
from aero_viz.scenes.world import World

VOXEL, VOXEL_RANGE = 0.2, (0.01, 100.0)
"""Default edge of a voxel and its bounds [m]."""
HEIGHT = 2.0
"""Height of a chosen start or goal above the local ground [m]."""
CLEARANCE = 0.75
"""Smallest distance from a chosen start or goal to an obstacle [m]."""
DRONE_RADIUS = 0.5
"""Radius of the drone for which a path to a chosen goal exists [m]."""
DISTANCE_MAX = 45.0
"""Largest distance from the start to a chosen goal [m]."""
_RECENTRE_BEYOND = 10_000.0  # [m]; farther out, float32 does not resolve millimetres
_TILE = 4.0  # [m]; the local ground is the low end of the points in a square of this edge
_CELL = 0.5  # [m]; grid spacing of the search for a start and a goal ..
_CELLS_MAX = 400  # .. with at most this many cells along the map
_SAMPLES_MAX = 100_000  # points sampled on a mesh: one per square metre, up to this number
_CLEARANCE_ENOUGH = 1.5  # [m]; a larger clearance does not make a start better

Array = NDArray[np.float64]


def load_map(
    path: str | Path,
    *,
    voxel: float | None = None,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    across: bool = False,
    points: Array | None = None,
) -> World:
    """Return the world of a point map (see `read_points`), a mesh (see `read_mesh`) or solids (see `read_solids`).

    Every voxel that holds a point is solid; neighbours are merged into larger boxes. The triangles of a mesh and solids
    are kept as they are. A map with points farther than 10 km from its origin is shifted so that its lowest corner is
    near the origin; `start` and `goal` are shifted with it.

    Args:
        path: file; its stem becomes the name of the world.
        voxel: edge of a voxel [m], about the spacing of the points: a smaller one leaves holes, a larger one closes
            gaps. None is 0.2. Of an occupancy image, the edge of a pixel. A mesh and a Gazebo world have no voxels.
        start: [m], [3], in the frame of the map. None chooses a position 2 m above the local ground, at least 0.75 m
            and preferably 1.5 m from all obstacles: near the origin of the map, or near its centre where the origin
            lies outside; about 45 m from `goal` if that is set.
        goal: [m], [3], in the frame of the map. None chooses the farthest such position within 45 m of the start that
            a drone of radius 0.5 m can reach.
        across: True chooses start and goal at the two ends of the longest side instead, as far apart as possible.
        points: points of the map [n, 3] [m] that were read from the file before; None reads them.

    Raises:
        UserError: the file cannot be read, an argument is out of range, or there is no free start or goal.
    """
    if voxel is not None and not VOXEL_RANGE[0] <= voxel <= VOXEL_RANGE[1]:
        raise UserError(
            f"The voxels of the map {path} have an edge of {voxel!r} m; it must be in {list(VOXEL_RANGE)} m."
        )
    if points is not None:
        cloud, tables = _read_map(path, voxel, points)
    elif Path(path).suffix.lower() in SOLID_SUFFIXES:
        cloud, tables = _read_solids(path, voxel)
    else:
        cloud, tables = _read_map(path, voxel, read_map(path))
    cloud, shift = recentred(cloud)
    tables = {key: _moved(key, table, -shift) for key, table in tables.items()}
    return complete_world(path, cloud, tables, shift=shift, start=start, goal=goal, across=across)


def recentred(points: Array) -> tuple[Array, Array]:
    """Return points [n, 3] [m] near the origin and the shift that was subtracted, zero unless one is beyond 10 km."""
    # Maps in geographic coordinates are recentred in double precision.
    shift = np.floor(points.min(axis=0)) if np.abs(points).max() > _RECENTRE_BEYOND else np.zeros(3)
    return points - shift, shift


def complete_world(
    path: str | Path,
    points: Array,
    tables: dict[str, Array],
    *,
    shift: Array,
    start: ArrayLike | None,
    goal: ArrayLike | None,
    across: bool = False,
) -> World:
    """Return the world of some tables with start and goal, which are given before the shift, or chosen; see `load_map`.

    Args:
        path: file; its stem becomes the name of the world.
        points: points of the map [n, 3] [m], from which the height of the ground is taken.
        tables: tables of the world by name.
        shift: what was subtracted from points and tables [m], [3].
        start, goal, across: those of `load_map`.

    Raises:
        UserError: start or goal is no position, or there is no free one.
    """
    start_position = None if start is None else _position(start, "start") - shift
    goal_position = None if goal is None else _position(goal, "goal") - shift
    try:
        if start_position is None or goal_position is None:
            start_position, goal_position = _choose_ends(
                points, tables, start_position, goal_position, across=across, path=path
            )
        return World(Path(path).stem, start_position, goal_position, mission=None, **tables)
    except ValueError as error:
        raise UserError(f"Cannot make a world of the map {path}: {error}") from error


def _read_map(path: str | Path, voxel: float | None, table: Array) -> tuple[Array, dict[str, Array]]:
    """Return points of a map or on a mesh [n, 3], and the tables of its world; `table` is a result of `read_map`."""
    if table.shape[1] == 9:
        if voxel is not None:
            raise UserError(f"{path} is a mesh, which has no voxels; leave their size out.")
        check_span(table.reshape(-1, 3), path)
        points = _sample(table)
        return points, {"triangles": table}
    check_span(table, path)
    edge = VOXEL if voxel is None else voxel
    # Far from the origin the boxes are shifted with the points, to the same voxels.
    near, shift = recentred(table)
    boxes = merge_voxels(occupied_voxels(near, edge, path), edge)
    return table, {"boxes": _moved("boxes", boxes, shift)}


def _read_solids(path: str | Path, pixel: float | None) -> tuple[Array, dict[str, Array]]:
    """Return points at the ground and at the top of a world of solids [n, 3], and its tables."""
    if pixel is not None and Path(path).suffix.lower() in (".world", ".sdf"):
        raise UserError(f"{path} is a Gazebo world, which has no voxels; leave their size out.")
    solids = read_solids(path, pixel=pixel)
    tables = solids.tables()
    obstacles = {key: table[:-1] if key == "boxes" and solids.ground is not None else table
                 for key, table in tables.items()}  # fmt: skip
    empty = {"cylinders": 8, "boxes": 7, "spheres": 4}
    bounds = primitive_bounds(*(obstacles.get(key, np.zeros((0, columns))) for key, columns in empty.items()))
    corners = np.vstack([*bounds, tables.get("triangles", np.zeros((0, 9))).reshape(-1, 3)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    if solids.ground is not None:
        low[2] = solids.ground[2] + 0.5 * solids.ground[5]
    check_span(np.stack([low, high]), path)
    ends = np.stack([low, np.maximum(high, low)])
    return np.array([[x, y, z] for x in ends[:, 0] for y in ends[:, 1] for z in ends[:, 2]]), tables


def _moved(key: str, table: Array, offset: Array) -> Array:
    """Return a table of a world, moved by an offset [m], [3]."""
    positions = 3 if key == "triangles" else 1
    move = np.zeros(table.shape[1])
    move[: 3 * positions] = np.tile(offset, positions)
    return table + move


def _position(value: ArrayLike, name: str) -> Array:
    position = np.array(value, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise UserError(f"The {name} {np.asarray(value).tolist()} is not a position; give three finite numbers.")
    return position


def check_span(points: Array, path: str | Path) -> None:
    """Refuse a map that is wider than any flight, which a single stray point can make of it."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    with np.errstate(over="ignore"):
        span = upper - lower
    axis = int(np.argmax(span))
    if span[axis] <= MAP_SPAN_MAX:
        check_place(lower, path)
        return
    middle = np.median(points[:, axis])
    stray = int((np.abs(points[:, axis] - middle) > 0.5 * MAP_SPAN_MAX).sum())
    raise UserError(
        f"The map {path} spans {span[axis] / 1e3:.4g} km along {'xyz'[axis]}, and at most "
        f"{MAP_SPAN_MAX / 1e3:g} km can be used: crop it; {stray} of its {len(points)} points lie more than "
        f"{0.5 * MAP_SPAN_MAX / 1e3:g} km from the middle."
    )


def occupied_voxels(points: Array, edge: float, path: str | Path) -> NDArray[np.int64]:
    """Return the indices of the voxels that hold a point [n, 3], x slowest, z fastest."""
    first = np.floor(points.min(axis=0) / edge).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for axis in range(3):  # at most 2 000 000 voxels along an axis: three indices fit into one integer
        key = (key << 21) | (np.floor(points[:, axis] / edge).astype(np.int64) - first[axis])
    key = np.unique(key)
    if len(key) > MAP_VOXELS_MAX:
        raise UserError(
            f"The map {path} fills {len(key)} voxels of {edge:g} m, and at most {MAP_VOXELS_MAX} can be used: make "
            "them larger (--voxel), or crop the map."
        )
    return np.column_stack([key >> 42, (key >> 21) & 0x1FFFFF, key & 0x1FFFFF]) + first


def merge_voxels(voxels: NDArray[np.int64], edge: float) -> Array:
    """Return boxes [n, 7] that fill exactly the voxels with these indices [m, 3].

    Voxels are merged into runs along x, equal runs along y, then equal runs along z. Walls and floors then need a tenth
    of the boxes, and rays, distances and drawing take a tenth of the time.
    """
    low, high = voxels, voxels + 1
    for axis in range(3):
        across = [i for i in range(3) if i != axis]
        # Boxes with equal extent across the axis become neighbours, in order along the axis.
        keys = [low[:, axis], *(side[:, i] for i in across for side in (low, high))]
        order = np.lexsort(keys)
        low, high = low[order], high[order]
        follows = (low[1:, axis] == high[:-1, axis]) & np.all(low[1:, across] == low[:-1, across], axis=1)
        follows &= np.all(high[1:, across] == high[:-1, across], axis=1)
        first = np.concatenate([[True], ~follows])
        last = np.concatenate([~follows, [True]])
        low, high = low[first], high[last]
    rows = np.column_stack([0.5 * edge * (low + high), edge * (high - low), np.zeros(len(low))])
    return rows.astype(np.float64)


def _sample(triangles: Array) -> Array:
    """Return points on triangles [n, 9], dense enough to find the ground height in each tile: [m, 3].

    Triangles that face down are skipped if any face up: the underside of a floor is not ground.
    """
    a, b, c = np.split(triangles, 3, axis=1)
    normal = np.cross(b - a, c - a)
    area = 0.5 * np.linalg.norm(normal, axis=1)
    upward = normal[:, 2] > -area
    if upward.any() and not upward.all():
        return _sample(triangles[upward])
    count = np.ceil(np.minimum(area, area * _SAMPLES_MAX / max(area.sum(), 1.0))).astype(int)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(size=(2, int(count.sum()), 1))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (np.repeat(corner, count, axis=0) for corner in (a, b, c))
    return np.vstack([triangles.reshape(-1, 3), a + u * (b - a) + v * (c - a)])


def _choose_ends(
    points: Array, tables: dict[str, Array], start: Array | None, goal: Array | None, *, across: bool, path: str | Path
) -> tuple[Array, Array]:
    """Return start and goal; each one that is None is chosen as `load_map` describes."""
    from aero_viz.scenes.clearance_grid import ClearanceGrid

    lower, upper = points.min(axis=0), points.max(axis=0)
    extent = upper - lower + np.array([0.0, 0.0, HEIGHT])
    cell = max(_CELL, float((upper - lower).max()) / _CELLS_MAX)
    while math.prod((extent / cell + 3.0).tolist()) > MAP_CELLS_MAX:
        cell *= 1.1
    # The start of this world only anchors the grid.
    anchor = np.rint(0.5 * (lower + upper)) if start is None else start
    world = World("", anchor, anchor if goal is None else goal, mission=None, **tables)
    grid = ClearanceGrid.measure(
        world,
        cell=cell,
        distance_max=_CLEARANCE_ENOUGH,
        band=(lower[2], upper[2] + HEIGHT),
        region=[lower[:2], upper[:2]],
    )
    axes = [corner + cell * np.arange(count) for corner, count in zip(grid.corner, grid.distance.shape, strict=True)]
    places = np.stack(np.meshgrid(axes[0], axes[1], indexing="ij"), axis=-1)
    height = axes[2] - _ground_height(points, places)[..., None]
    free = (grid.distance >= CLEARANCE) & (np.abs(height - HEIGHT) <= 0.5 * cell + 1e-9)
    holds_origin = np.all((lower[:2] <= 0.0) & (upper[:2] >= 0.0))
    centre = np.zeros(2) if holds_origin else 0.5 * (lower + upper)[:2]
    ends = np.stack([0.5 * (lower + upper)[:2]] * 2)
    if across:
        side = int(np.argmax((upper - lower)[:2]))
        ends[:, side] = lower[side], upper[side]
        centre = ends[0]
    if start is None:
        error = np.linalg.norm(places - (centre if goal is None or across else goal[:2]), axis=-1)
        if goal is not None and not across:
            error = np.abs(error - DISTANCE_MAX)
        start = _best_position(axes, free, grid.distance - 0.05 * error[..., None], "start", path)
    if goal is None:
        reachable = grid.reachable(start, threshold=math.hypot(DRONE_RADIUS, 0.5 * cell))
        distance = np.hypot(np.linalg.norm(places - start[:2], axis=-1)[..., None], axes[2] - start[2])
        if across:
            nearness = np.broadcast_to(-np.linalg.norm(places - ends[1], axis=-1)[..., None], free.shape)
            goal = _best_position(axes, free & reachable, nearness, "goal", path)
        else:
            goal = _best_position(axes, free & reachable & (distance <= DISTANCE_MAX), distance, "goal", path)
    return start, goal


def _best_position(axes: list[Array], allowed: NDArray[np.bool_], score: Array, name: str, path: str | Path) -> Array:
    if not allowed.any():
        raise UserError(
            f"The map {path} has no free place {HEIGHT:g} m above its ground for the {name}: crop it, or give "
            "--start and --goal to demo or fly."
        )
    index = np.unravel_index(np.argmax(np.where(allowed, score, -np.inf)), score.shape)
    return np.array([axis[i] for axis, i in zip(axes, index, strict=True)])


def _ground_height(points: Array, places: Array) -> Array:
    """Return the ground height [m], [X, Y], at `places` [X, Y, 2].

    It is the fifth percentile of z in each square of 4 m, and that of all points where a square holds none.
    """
    lower = points[:, :2].min(axis=0)
    tiles = np.floor((points[:, :2] - lower) / _TILE).astype(int)
    shape = np.maximum(tiles.max(axis=0), np.floor((places.max(axis=(0, 1)) - lower) / _TILE).astype(int)) + 1
    height = np.full(shape, np.percentile(points[:, 2], 5))
    key = tiles[:, 0] * shape[1] + tiles[:, 1]
    order = np.lexsort([points[:, 2], key])
    occupied, first, count = np.unique(key[order], return_index=True, return_counts=True)
    height.ravel()[occupied] = points[order, 2][first + count // 20]
    tile = np.clip(np.floor((places - lower) / _TILE).astype(int), 0, shape - 1)
    return height[tile[..., 0], tile[..., 1]]
