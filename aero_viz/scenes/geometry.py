"""Worlds in Warp kernels: packed primitives, the grid over each world, and exact distances.

`device_worlds.py` fills these structs on the host.
"""

from __future__ import annotations

import warp as wp

from aero_viz.scenes.triangles import FAR, mesh_distance

wp.set_module_options({"enable_backward": False})

CYLINDER = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)


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
class Mover:
    """A cylinder that moves back and forth, see `World.motion`."""

    cylinder: Primitive
    """The cylinder at time 0."""
    direction: wp.vec3
    """Unit direction of the velocity at time 0."""
    speed: float
    """[m/s]"""
    span: float
    """Distance after which it turns back [m]."""


@wp.struct
class Grid:
    """Cells over the extent of one world's primitives: columns of a single layer, or cubes."""

    lower: wp.vec3
    """Lower corner of the axis-aligned box around the primitives [m]."""
    upper: wp.vec3
    """Upper corner [m]."""
    cell: float
    """Edge of a cell along x and y [m]."""
    layer: float
    """Height of a cell [m]."""
    columns: int
    """Number of cells along x."""
    rows: int
    """Number of cells along y."""
    layers: int
    """Number of cells along z."""
    first_cell: int
    """Index of cell (0, 0, 0) in `Geometry.cells`; then z runs fastest, x slowest."""
    first_large: int
    """`Geometry.large`[first_large .. end_large - 1] are the primitives that are not in the grid."""
    end_large: int


@wp.struct
class Entry:
    """A primitive in a cell, and the heights it covers in the column of the cell [m]."""

    primitive: int
    bottom: float
    top: float


@wp.struct
class Geometry:
    """Primitives, grids and triangles of W worlds."""

    primitives: wp.array(dtype=Primitive)
    """[P], world after world."""
    first: wp.array(dtype=int)
    """[W + 1]; world w owns primitives first[w] .. first[w + 1] - 1."""
    grids: wp.array(dtype=Grid)
    """[W]"""
    cells: wp.array(dtype=int)
    """[C + 1]; cell c owns entries cells[c] .. cells[c + 1] - 1."""
    entries: wp.array(dtype=Entry)
    """[E]"""
    large: wp.array(dtype=int)
    """[L], indices of the primitives that every ray tests."""
    movers: wp.array(dtype=Mover)
    """[M], world after world; they are not among the primitives, nor in the grids."""
    first_mover: wp.array(dtype=int)
    """[W + 1]; world w owns movers first_mover[w] .. first_mover[w + 1] - 1."""
    meshes: wp.array(dtype=wp.uint64)
    """[W], triangles of each world, see `TriangleTree.id`; 0 for a world without triangles."""


@wp.func
def rotate_z(v: wp.vec3, c: float, s: float):
    """Rotate about z by an angle with cosine c and sine s."""
    return wp.vec3(c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@wp.func
def solid_distance(x: float, y: float, z: float):
    """Signed distance to a solid from how far a point exceeds each of its half extents [m]."""
    outside = wp.length(wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0)))
    return outside + wp.min(wp.max(x, wp.max(y, z)), 0.0)


@wp.func
def primitive_distance(p: Primitive, point: wp.vec3):
    """Signed distance to the surface of a primitive [m], negative inside."""
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
def mover_at(m: Mover, time: float):
    """The cylinder at a time [s]: a triangle wave along its direction."""
    travelled = m.speed * time
    travelled -= 2.0 * m.span * wp.floor(travelled / (2.0 * m.span))
    cylinder = m.cylinder
    cylinder.origin = cylinder.origin + wp.min(travelled, 2.0 * m.span - travelled) * m.direction
    return cylinder


@wp.func
def world_distance(geometry: Geometry, world: int, point: wp.vec3, time: float, thread: int, threads: int):
    """Signed distance to the nearest surface of a world at a time [s], for one of the threads that share the query [m].

    The thread tests every threads-th primitive and mover, and thread 0 also the triangles, which have no inside. The
    result is the minimum over all threads; it is inf where a thread has nothing to test.
    """
    nearest = float(wp.inf)
    if thread == 0:
        nearest = mesh_distance(geometry.meshes[world], point, FAR)
    for i in range(geometry.first[world] + thread, geometry.first[world + 1], threads):
        nearest = wp.min(nearest, primitive_distance(geometry.primitives[i], point))
    for i in range(geometry.first_mover[world] + thread, geometry.first_mover[world + 1], threads):
        nearest = wp.min(nearest, primitive_distance(mover_at(geometry.movers[i], time), point))
    return nearest
