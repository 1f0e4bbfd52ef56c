"""Worlds as arrays on a Warp device, with a grid over the primitives of each for ray casting.

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.warp_init import init_warp
from aero_viz.scenes.geometry import BOX, CYLINDER, SPHERE, Entry, Geometry, Grid, Mover, Primitive
from aero_viz.scenes.primitives import primitive_bounds
from aero_viz.scenes.triangles import TriangleTree
from aero_viz.scenes.world import World

COLUMNS_PRIMITIVES_MAX = 5000
"""Worlds with more primitives (maps) get cubic cells instead of columns."""

_PIECE = 0.5  # [m]; an inclined cylinder is entered in the grid in pieces of this length
_PADDING = 1e-3  # [m]; well above the float32 rounding of a point 100 m away
_COLUMN_MIN = 1.0  # smallest edge of a column [m]
_COLUMNS_MAX = 100_000  # approximate limit of a grid, however far apart the obstacles are
_CUBE = (0.2, 1.0)  # cubes have twice the typical size of a primitive, between these edges [m]
_CUBES_MAX = 4_000_000  # approximate limit
_LARGE = 2000.0  # [m^2]; primitives that cover more, such as the ground, are tested for every ray

_Pieces = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]


class DeviceWorlds:
    """Worlds as float32 arrays on a device.

    Args:
        worlds: one per flight; flights that share a World object share its primitives.
        device: Warp device.

    Attributes:
        geometry: `Geometry` of the distinct worlds, for kernels.
        index: world of each flight, int [B], on the device.
        has_triangles: True if any of the worlds contains triangles.
        device: Warp device.
    """

    def __init__(self, worlds: Sequence[World], *, device: Any = "cpu") -> None:
        unique = list({id(world): world for world in worlds}.values())
        position = {id(world): i for i, world in enumerate(unique)}
        movers = [_pack_movers(world) for world in unique]
        first_mover = np.concatenate([[0], np.cumsum([len(m) for m in movers])])
        standing = [world.standing() for world in unique]
        primitives = [pack_primitives(world) for world in standing]
        first = np.concatenate([[0], np.cumsum([len(p) for p in primitives])])
        grids = np.zeros(len(unique), dtype=_dtype(Grid))
        counts, entries, large = [np.zeros(1, dtype=int)], [], []
        for grid, world, start in zip(grids, standing, first[:-1], strict=True):
            pieces, large_primitives = _pieces(world)
            grid["first_cell"] = sum(map(len, counts)) - 1
            grid["first_large"] = sum(map(len, large))
            grid["end_large"] = grid["first_large"] + len(large_primitives)
            cell_counts, cell_entries = _fill(grid, *pieces)
            cell_entries["primitive"] += start
            counts.append(cell_counts)
            entries.append(cell_entries)
            large.append(large_primitives + start)
        # The trees must live as long as the geometry that refers to them.
        self._trees = [
            TriangleTree(world.triangles, device=device) if len(world.triangles) else None for world in unique
        ]
        self.has_triangles = any(self._trees)

        init_warp()
        self.device = wp.get_device(device)
        with wp.ScopedDevice(self.device):
            self.index = wp.array([position[id(world)] for world in worlds], dtype=int)
            self.geometry: Any = Geometry()
            self.geometry.primitives = wp.array(np.concatenate(primitives), dtype=Primitive)
            self.geometry.first = wp.array(first, dtype=int)
            self.geometry.grids = wp.array(grids, dtype=Grid)
            self.geometry.cells = wp.array(np.cumsum(np.concatenate(counts)), dtype=int)
            self.geometry.entries = wp.array(np.concatenate(entries), dtype=Entry)
            self.geometry.large = wp.array(np.concatenate(large), dtype=int)
            self.geometry.movers = wp.array(np.concatenate(movers), dtype=Mover)
            self.geometry.first_mover = wp.array(first_mover, dtype=int)
            self.geometry.meshes = wp.array([tree.id if tree else 0 for tree in self._trees], dtype=wp.uint64)


def _dtype(struct: Any) -> np.dtype[Any]:
    return np.dtype(struct.numpy_dtype())


def pack_primitives(world: World) -> NDArray[Any]:
    """Return the cylinders, boxes and spheres of a world, in this order, as `Primitive`, structured array [P]."""
    rows = np.zeros(len(world.cylinders) + len(world.boxes) + len(world.spheres), dtype=_dtype(Primitive))
    cylinders, boxes, spheres = np.split(rows, np.cumsum([len(world.cylinders), len(world.boxes)]))
    cylinders["kind"], boxes["kind"], spheres["kind"] = CYLINDER, BOX, SPHERE
    cylinders["origin"], cylinders["axis"], cylinders["size"] = np.split(world.cylinders, [3, 6], axis=1)
    yaw = world.boxes[:, 6]
    boxes["origin"], boxes["axis"] = world.boxes[:, :3], 0.5 * world.boxes[:, 3:6]
    boxes["size"] = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    spheres["origin"], spheres["size"][:, 0] = world.spheres[:, :3], world.spheres[:, 3]
    return rows


def _pack_movers(world: World) -> NDArray[Any]:
    """Return the cylinders that move as `Mover`, structured array [M]."""
    rows = np.flatnonzero(world.moves)
    movers = np.zeros(len(rows), dtype=_dtype(Mover))
    if len(rows):
        velocity = world.motion[rows, :2]
        movers["cylinder"] = pack_primitives(world)[rows]
        movers["speed"], movers["span"] = np.linalg.norm(velocity, axis=1), world.motion[rows, 2]
        movers["direction"][:, :2] = velocity / movers["speed"][:, None]
    return movers


def _pieces(world: World) -> tuple[_Pieces, NDArray[np.int64]]:
    """Return axis-aligned boxes that cover the solids in the grid, and the primitives that are too large for it.

    The boxes are padded lower and upper corners [n, 3], and the primitive that each belongs to [n].
    """
    table = world.cylinders
    count = np.clip(np.ceil(table[:, 7] / _PIECE), 1, 1000).astype(int)
    count[np.abs(table[:, 5]) > 1.0 - 1e-6] = 1  # one box fits a vertical cylinder
    piece = np.repeat(np.arange(len(table)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    cut = table[piece]
    cut[:, 7] /= count[piece]
    cut[:, :3] += (number * cut[:, 7])[:, None] * cut[:, 3:6]
    lower, upper = primitive_bounds(cut, world.boxes, world.spheres)
    owner = np.concatenate([piece, len(table) + np.arange(len(world.boxes) + len(world.spheres))])
    fits = np.prod((upper - lower)[:, :2], axis=1) <= _LARGE
    fits &= ~np.isin(owner, owner[~fits])
    return (lower[fits] - _PADDING, upper[fits] + _PADDING, owner[fits]), np.unique(owner[~fits])


def _fill(
    grid: Any, lower: NDArray[np.float64], upper: NDArray[np.float64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Fit `grid` to the boxes; return the number of entries of each cell, and all entries cell by cell."""
    if len(owner) == 0:
        grid["upper"] = -1.0  # no ray enters
        return np.zeros(0, dtype=int), np.zeros(0, dtype=_dtype(Entry))
    grid["lower"], grid["upper"] = lower.min(axis=0), upper.max(axis=0)
    extent = grid["upper"] - grid["lower"]
    edges, shape = _resolution(extent, upper - lower, len(np.unique(owner)))
    grid["cell"], grid["layer"] = edges[0], edges[2]
    grid["columns"], grid["rows"], grid["layers"] = shape
    low = np.clip(np.floor((lower - grid["lower"]) / edges).astype(int), 0, shape - 1)
    high = np.clip(np.floor((upper - grid["lower"]) / edges).astype(int), 0, shape - 1)
    span = high - low + 1
    total = span.prod(axis=1)
    box = np.repeat(np.arange(len(owner)), total)
    number = np.arange(len(box)) - np.repeat(np.cumsum(total) - total, total)
    step_x, step_y = span[box, 1] * span[box, 2], span[box, 2]
    x, y, z = number // step_x, number // step_y % span[box, 1], number % step_y
    cell = ((low[box, 0] + x) * shape[1] + low[box, 1] + y) * shape[2] + low[box, 2] + z

    # Pieces of the same primitive in the same cell become one entry.
    key = cell * (owner.max() + 1) + owner[box]
    order = np.argsort(key, kind="stable")
    key, first = np.unique(key[order], return_index=True)
    entries = np.zeros(len(key), dtype=_dtype(Entry))
    entries["primitive"] = key % (owner.max() + 1)
    entries["bottom"] = np.minimum.reduceat(lower[box[order], 2], first)
    entries["top"] = np.maximum.reduceat(upper[box[order], 2], first)
    return np.bincount(key // (owner.max() + 1), minlength=int(shape.prod())), entries


def _resolution(
    extent: NDArray[np.float32], sizes: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the edges of a cell [m], [3], and the number of cells along each axis, [3].

    Columns suit obstacles that are as tall as the world. In a map, a ray would meet a floor, walls and a ceiling in
    every column, so maps get cubes.

    Args:
        extent: of the grid [m], [3].
        sizes: of the pieces of the primitives [m], [n, 3].
        count: number of primitives.
    """
    if count <= COLUMNS_PRIMITIVES_MAX:
        flat = extent[:2]
        edge = max(_COLUMN_MIN, np.sqrt(np.prod(flat) / _COLUMNS_MAX), flat.max() / _COLUMNS_MAX)
        edges = np.array([edge, edge, 2.0 * extent[2]], dtype=np.float32)
    else:
        edge = np.clip(2.0 * np.median(sizes.max(axis=1)), *_CUBE)
        edge = max(edge, np.cbrt(np.prod(extent) / _CUBES_MAX), extent.max() / _COLUMNS_MAX)
        edges = np.full(3, edge, dtype=np.float32)
    return edges, np.maximum(1, np.ceil(extent / edges)).astype(int)
