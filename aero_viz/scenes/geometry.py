"""Worlds on the device: packed primitives, a grid over each world, its triangles, exact distances in Warp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.warp_init import quieten
from aero_viz.scenes.triangles import TriangleTree, mesh_distance
from aero_viz.scenes.world import World, primitive_bounds

__all__ = ["DeviceWorlds", "Geometry", "Primitive", "device_primitives", "primitive_distance", "world_distance"]

wp.set_module_options({"enable_backward": False})

CYLINDER = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)
FAR = wp.constant(1.0e9)

_SEGMENT = 0.5  # [m]; an inclined cylinder is entered in the grid in pieces of this length
_PADDING = 1e-3  # [m]; well above float32 rounding of a point 100 m away
_CELL = 1.0  # smallest edge of a column [m]
_CELLS = 100_000  # about as many columns a grid has at most, however far apart the obstacles are
_MANY = 5000  # worlds of more primitives, maps, get cubic cells instead of columns ..
_CUBE = (0.2, 1.0)  # .. of twice a primitive's typical size, between these edges [m] ..
_CUBES = 4_000_000  # .. and about as many at most
_EVERYWHERE = 2000.0  # [m^2]; what covers more is tested for every ray: the ground


@wp.struct
class Primitive:
    """One solid, world frame."""

    kind: int
    origin: wp.vec3
    """Base centre of a cylinder, centre of a box or sphere [m]."""
    axis: wp.vec3
    """Unit axis of a cylinder; half edge lengths of a box [m]."""
    size: wp.vec2
    """Radius and height of a cylinder [m]; cosine and sine of a box's yaw; radius of a sphere [m] and 0."""


@wp.struct
class Grid:
    """Cells over the extent of one world's primitives: columns of one layer, or cubes."""

    lower: wp.vec3
    """Corner of the primitives' axis-aligned box [m]."""
    upper: wp.vec3
    cell: float
    """Edge of a cell, x and y [m]."""
    layer: float
    """Height of a cell [m]."""
    columns: int
    """Number of cells along x."""
    rows: int
    """Number of cells along y."""
    layers: int
    """Number of cells along z."""
    first_cell: int
    """Position of cell (0, 0, 0) in `Geometry.cells`; then z runs fastest, x slowest."""
    first_large: int
    """`Geometry.large`[first_large .. end_large - 1] are the primitives outside the grid."""
    end_large: int


@wp.struct
class Entry:
    """A primitive in a cell, and the heights it covers in the cell's column [m]."""

    primitive: int
    bottom: float
    top: float


@wp.struct
class Geometry:
    """All primitives of all worlds."""

    primitives: wp.array(dtype=Primitive)
    first: wp.array(dtype=int)
    """World w owns primitives first[w] .. first[w + 1] - 1."""
    grids: wp.array(dtype=Grid)
    cells: wp.array(dtype=int)
    """Cell c owns entries cells[c] .. cells[c + 1] - 1."""
    entries: wp.array(dtype=Entry)
    large: wp.array(dtype=int)
    meshes: wp.array(dtype=wp.uint64)
    """Triangles of each world, see `TriangleTree.id`; 0 for none."""


@wp.func
def rotate_z(v: wp.vec3, c: float, s: float):
    return wp.vec3(c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@wp.func
def solid_distance(x: float, y: float, z: float):
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    return outside + wp.min(wp.max(x, wp.max(y, z)), 0.0)


@wp.func
def primitive_distance(p: Primitive, point: wp.vec3):
    """Signed distance to the surface [m], negative inside."""
    relative = point - p.origin
    if p.kind == CYLINDER:
        height = wp.dot(relative, p.axis)
        across = wp.length(relative - height * p.axis)
        half = 0.5 * p.size[1]
        return solid_distance(across - p.size[0], wp.abs(height - half) - half, -FAR)
    if p.kind == BOX:
        local = rotate_z(relative, p.size[0], -p.size[1])
        return solid_distance(wp.abs(local[0]) - p.axis[0], wp.abs(local[1]) - p.axis[1], wp.abs(local[2]) - p.axis[2])
    return wp.length(relative) - p.size[0]


@wp.func
def world_distance(geometry: Geometry, world: int, point: wp.vec3, lane: int, lanes: int):
    """Signed distance to the nearest surface of a world [m] among every lanes-th primitive; inf without any.

    Lane 0 looks at the triangles, too, which have no inside.
    """
    nearest = float(wp.inf)
    if lane == 0:
        nearest = mesh_distance(geometry.meshes[world], point, FAR)
    for i in range(geometry.first[world] + lane, geometry.first[world + 1], lanes):
        nearest = wp.min(nearest, primitive_distance(geometry.primitives[i], point))
    return nearest


def device_primitives(world: World, *, device: Any = "cpu") -> wp.array:
    """Return the primitives of a world on a device, `Primitive` [n]: cylinders, boxes, spheres, in this order."""
    return wp.array(_pack(world), dtype=Primitive, device=device)


class DeviceWorlds:
    """Worlds as arrays on a device, float32.

    Args:
        worlds: one world per flight; flights that share a World object share its primitives.
        device: Warp device.

    Attributes:
        geometry: to pass to kernels.
        index: world of each flight, int [B], on the device.
        device: Warp device.
    """

    def __init__(self, worlds: Sequence[World], *, device: Any = "cpu") -> None:
        unique = list({id(world): world for world in worlds}.values())
        position = {id(world): i for i, world in enumerate(unique)}
        primitives = [_pack(world) for world in unique]
        first = np.concatenate([[0], np.cumsum([len(p) for p in primitives])])
        grids = np.zeros(len(unique), dtype=Grid.numpy_dtype())
        counts, entries, large = [np.zeros(1, dtype=int)], [], []
        for grid, world, start in zip(grids, unique, first[:-1], strict=True):
            pieces, outside = _pieces(world)
            grid["first_cell"] = sum(map(len, counts)) - 1
            grid["first_large"] = sum(map(len, large))
            grid["end_large"] = grid["first_large"] + len(outside)
            cell_counts, cell_entries = _fill(grid, *pieces)
            cell_entries["primitive"] += start
            counts.append(cell_counts)
            entries.append(cell_entries)
            large.append(outside + start)
        # Their hierarchies live as long as this object.
        self._trees = [
            TriangleTree(world.triangles, device=device) if len(world.triangles) else None for world in unique
        ]

        quieten()
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
            self.geometry.meshes = wp.array([tree.id if tree else 0 for tree in self._trees], dtype=wp.uint64)


def _pack(world: World) -> NDArray[Any]:
    rows = np.zeros(len(world.cylinders) + len(world.boxes) + len(world.spheres), dtype=Primitive.numpy_dtype())
    cylinders, boxes, spheres = np.split(rows, np.cumsum([len(world.cylinders), len(world.boxes)]))
    cylinders["kind"], boxes["kind"], spheres["kind"] = CYLINDER, BOX, SPHERE
    cylinders["origin"], cylinders["axis"], cylinders["size"] = np.split(world.cylinders, [3, 6], axis=1)
    yaw = world.boxes[:, 6]
    boxes["origin"], boxes["axis"] = world.boxes[:, :3], 0.5 * world.boxes[:, 3:6]
    boxes["size"] = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    spheres["origin"], spheres["size"][:, 0] = world.spheres[:, :3], world.spheres[:, 3]
    return rows


_Pieces = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]


def _pieces(world: World) -> tuple[_Pieces, NDArray[np.int64]]:
    """Return what goes into the grid, as axis-aligned boxes that cover the solids, and the primitives too large for it.

    Boxes are lower and upper corners [m, 3], padded, and the primitive each belongs to [m].
    """
    table = world.cylinders
    count = np.clip(np.ceil(table[:, 7] / _SEGMENT), 1, 1000).astype(int)
    count[np.abs(table[:, 5]) > 1.0 - 1e-6] = 1  # one box fits a vertical cylinder
    piece = np.repeat(np.arange(len(table)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    cut = table[piece]
    cut[:, 7] /= count[piece]
    cut[:, :3] += (number * cut[:, 7])[:, None] * cut[:, 3:6]
    lower, upper = primitive_bounds(cut, world.boxes, world.spheres)
    owner = np.concatenate([piece, len(table) + np.arange(len(world.boxes) + len(world.spheres))])
    fits = np.prod((upper - lower)[:, :2], axis=1) <= _EVERYWHERE
    fits &= ~np.isin(owner, owner[~fits])
    return (lower[fits] - _PADDING, upper[fits] + _PADDING, owner[fits]), np.unique(owner[~fits])


def _fill(
    grid: Any, lower: NDArray[np.float64], upper: NDArray[np.float64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Fit `grid` to the boxes; return the number of entries of each cell and all entries, cell by cell."""
    if len(owner) == 0:
        grid["upper"] = -1.0  # no ray enters
        return np.zeros(0, dtype=int), np.zeros(0, dtype=Entry.numpy_dtype())
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

    # Pieces of one primitive in one cell become one entry.
    key = cell * (owner.max() + 1) + owner[box]
    order = np.argsort(key, kind="stable")
    key, first = np.unique(key[order], return_index=True)
    entries = np.zeros(len(key), dtype=Entry.numpy_dtype())
    entries["primitive"] = key % (owner.max() + 1)
    entries["bottom"] = np.minimum.reduceat(lower[box[order], 2], first)
    entries["top"] = np.maximum.reduceat(upper[box[order], 2], first)
    return np.bincount(key // (owner.max() + 1), minlength=int(shape.prod())), entries


def _resolution(
    extent: NDArray[np.float32], sizes: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the edges of a cell [m] and the number of cells, each [3], of a grid over `extent` [m], [3].

    Columns suit obstacles that are as tall as the world; a ray through a map would pass a floor, walls and a ceiling in
    every column. `sizes` [m, 3] are those of the pieces of `count` primitives.
    """
    if count <= _MANY:
        flat = extent[:2]
        edge = max(_CELL, np.sqrt(np.prod(flat) / _CELLS), flat.max() / _CELLS)
        edges = np.array([edge, edge, 2.0 * extent[2]], dtype=np.float32)
    else:
        edge = np.clip(2.0 * np.median(sizes.max(axis=1)), *_CUBE)
        edge = max(edge, np.cbrt(np.prod(extent) / _CUBES), extent.max() / _CELLS)
        edges = np.full(3, edge, dtype=np.float32)
    return edges, np.maximum(1, np.ceil(extent / edges)).astype(int)
