"""Ray casting: the nearest solid along each ray, batched over flights in their own worlds.

Obstacle fields are wide and flat, and a ray ends at its first hit. A grid (columns, or cubes in maps) that is traversed
cell by cell from the sensor is therefore two to ten times as fast as a bounding volume hierarchy, on a CPU core in the
built-in scenes. Triangles are queried in Warp's hierarchy first; a hit there shortens the traversal of the grid.
"""

from __future__ import annotations

import math

import warp as wp

from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.geometry import BOX, CYLINDER, FAR, Geometry, Primitive, mover_at, rotate_z
from aero_viz.scenes.triangles import mesh_range

wp.set_module_options({"enable_backward": False})


@wp.func
def cylinder_range(p: Primitive, origin: wp.vec3, direction: wp.vec3):
    relative = origin - p.origin
    height = wp.dot(relative, p.axis)
    climb = wp.dot(direction, p.axis)
    enter = float(-FAR)
    leave = float(FAR)
    if wp.abs(climb) > 1.0e-7:
        bottom = -height / climb
        top = (p.size[1] - height) / climb
        enter = wp.min(bottom, top)
        leave = wp.max(bottom, top)
    elif height < 0.0 or height > p.size[1]:
        return wp.inf
    across = relative - height * p.axis
    slide = direction - climb * p.axis
    a = wp.dot(slide, slide)
    if a < 1.0e-10:
        if wp.length_sq(across) > p.size[0] * p.size[0]:
            return wp.inf
    else:
        # Solve the quadratic from the point nearest to the axis: from the origin, b^2 - a c would cancel for a thin and
        # distant cylinder. Clamp it between the caps: a ray along the axis has its nearest point at infinity.
        nearest = wp.clamp(-wp.dot(across, slide) / a, enter, leave)
        near = across + nearest * slide
        b = wp.dot(near, slide)
        c = wp.length_sq(near) - p.size[0] * p.size[0]
        discriminant = b * b - a * c
        if discriminant < 0.0:
            return wp.inf
        root = wp.sqrt(discriminant)
        enter = wp.max(enter, nearest - (b + root) / a)
        leave = wp.min(leave, nearest - (b - root) / a)
    if leave < 0.0 or enter > leave:
        return wp.inf
    return wp.max(enter, 0.0)


@wp.func
def box_range(p: Primitive, origin: wp.vec3, direction: wp.vec3):
    o = rotate_z(origin - p.origin, p.size[0], -p.size[1])
    d = rotate_z(direction, p.size[0], -p.size[1])
    enter = float(-FAR)
    leave = float(FAR)
    for i in range(3):
        if wp.abs(d[i]) > 1.0e-9:
            low = (-p.axis[i] - o[i]) / d[i]
            high = (p.axis[i] - o[i]) / d[i]
            enter = wp.max(enter, wp.min(low, high))
            leave = wp.min(leave, wp.max(low, high))
        elif wp.abs(o[i]) > p.axis[i]:
            return wp.inf
    if leave < 0.0 or enter > leave:
        return wp.inf
    return wp.max(enter, 0.0)


@wp.func
def sphere_range(p: Primitive, origin: wp.vec3, direction: wp.vec3):
    relative = origin - p.origin
    nearest = -wp.dot(relative, direction)
    discriminant = p.size[0] * p.size[0] - wp.length_sq(relative + nearest * direction)
    if discriminant < 0.0:
        return wp.inf
    root = wp.sqrt(discriminant)
    if nearest + root < 0.0:
        return wp.inf
    return wp.max(nearest - root, 0.0)


@wp.func
def primitive_range(p: Primitive, origin: wp.vec3, direction: wp.vec3):
    """Distance along a unit direction to a primitive [m]: 0 from inside, inf for a miss."""
    if p.kind == CYLINDER:
        return cylinder_range(p, origin, direction)
    if p.kind == BOX:
        return box_range(p, origin, direction)
    return sphere_range(p, origin, direction)


@wp.func
def cell_index(offset: float, cell: float, count: int):
    return wp.clamp(int(wp.floor(offset / cell)), 0, count - 1)


@wp.func
def inverse_of(direction: float):
    """Return 1 / direction, or 0 for a ray that never leaves a cell along this axis."""
    return wp.where(wp.abs(direction) > 1.0e-9, 1.0 / direction, 0.0)


@wp.func
def cell_exit(index: int, cell: float, lower: float, inverse: float):
    """Distance along the ray at which it leaves a cell along one axis; `lower` is relative to the origin of the ray."""
    distance = (lower + cell * float(index + wp.where(inverse > 0.0, 1, 0))) * inverse
    return wp.where(inverse == 0.0, FAR, distance)


@wp.func
def ray_range(
    geometry: Geometry,
    world: int,
    origin: wp.vec3,
    direction: wp.vec3,
    triangle: float,
    range_max: float,
    time: float,
):
    """Distance along a unit direction to the nearest solid of a world [m]; inf if none is within range_max.

    `triangle` is the distance to the nearest triangle [m], see `mesh_range`; inf in a world without triangles.
    The cylinders that move are where they are at `time` [s]. Every ray tests all of them: they are few, and a grid
    would have to be filled again at every tick.
    """
    grid = geometry.grids[world]
    nearest = float(triangle)
    for i in range(grid.first_large, grid.end_large):
        nearest = wp.min(nearest, primitive_range(geometry.primitives[geometry.large[i]], origin, direction))

    for i in range(geometry.first_mover[world], geometry.first_mover[world + 1]):
        nearest = wp.min(nearest, cylinder_range(mover_at(geometry.movers[i], time), origin, direction))

    # The part of the ray inside the grid.
    enter = float(0.0)
    leave = wp.min(range_max, nearest)
    inverse = wp.vec3(inverse_of(direction[0]), inverse_of(direction[1]), inverse_of(direction[2]))
    for i in range(3):
        if inverse[i] != 0.0:
            low = (grid.lower[i] - origin[i]) * inverse[i]
            high = (grid.upper[i] - origin[i]) * inverse[i]
            enter = wp.max(enter, wp.min(low, high))
            leave = wp.min(leave, wp.max(low, high))
        elif origin[i] < grid.lower[i] or origin[i] > grid.upper[i]:
            leave = -1.0

    if enter <= leave:
        column = cell_index(origin[0] + enter * direction[0] - grid.lower[0], grid.cell, grid.columns)
        row = cell_index(origin[1] + enter * direction[1] - grid.lower[1], grid.cell, grid.rows)
        level = cell_index(origin[2] + enter * direction[2] - grid.lower[2], grid.layer, grid.layers)
        while enter <= leave:
            exit_x = cell_exit(column, grid.cell, grid.lower[0] - origin[0], inverse[0])
            exit_y = cell_exit(row, grid.cell, grid.lower[1] - origin[1], inverse[1])
            exit_z = cell_exit(level, grid.layer, grid.lower[2] - origin[2], inverse[2])
            out = wp.min(wp.min(leave, exit_z), wp.min(exit_x, exit_y))
            z_in = origin[2] + enter * direction[2]
            z_out = origin[2] + out * direction[2]
            cell = grid.first_cell + (column * grid.rows + row) * grid.layers + level
            for e in range(geometry.cells[cell], geometry.cells[cell + 1]):
                entry = geometry.entries[e]
                if wp.max(z_in, z_out) >= entry.bottom and wp.min(z_in, z_out) <= entry.top:
                    hit = primitive_range(geometry.primitives[entry.primitive], origin, direction)
                    nearest = wp.min(nearest, hit)
            # Beyond this cell there may be a nearer hit in the next one.
            leave = wp.min(leave, nearest)
            enter = out
            outside = False
            if exit_z < exit_x and exit_z < exit_y:
                level += wp.where(direction[2] > 0.0, 1, -1)
                outside = level < 0 or level >= grid.layers
            elif exit_x < exit_y:
                column += wp.where(direction[0] > 0.0, 1, -1)
                outside = column < 0 or column >= grid.columns
            else:
                row += wp.where(direction[1] > 0.0, 1, -1)
                outside = row < 0 or row >= grid.rows
            if out >= leave or outside:
                enter = leave + 1.0
    return wp.where(nearest <= range_max, nearest, wp.inf)


@wp.kernel
def cast_kernel(
    # problem
    geometry: Geometry,
    world: wp.array(dtype=int),  # [B]
    range_max: float,
    time: float,
    # in
    origins: wp.array(dtype=wp.vec3),  # [B]
    directions: wp.array2d(dtype=wp.vec3),  # [B, R]
    # out
    ranges: wp.array2d(dtype=float),  # [B, R]
):
    b, i = wp.tid()
    # Numbers that are not finite would index cells outside the grid.
    if not (wp.isfinite(origins[b]) and wp.isfinite(directions[b, i])):
        ranges[b, i] = wp.inf
        return
    triangle = mesh_range(geometry.meshes[world[b]], origins[b], directions[b, i], range_max)
    ranges[b, i] = ray_range(geometry, world[b], origins[b], directions[b, i], triangle, range_max, time)


def cast(
    worlds: DeviceWorlds, origins: wp.array, directions: wp.array, *, range_max: float = math.inf, time: float = 0.0
) -> wp.array:
    """Return the distance along each ray to the nearest solid [m], float [B, R] on the worlds' device.

    The distance is 0 from inside a solid and inf where nothing is within range_max, and for a ray whose origin or
    direction is not finite.

    Args:
        worlds: worlds of the B flights.
        origins: origin of the rays of each flight [m], vec3 [B], world frame.
        directions: unit vectors, vec3 [B, R], world frame.
        range_max: [m].
        time: when the rays are cast [s]; obstacles may move.
    """
    ranges = wp.empty(directions.shape, dtype=float, device=worlds.device)
    inputs = [worlds.geometry, worlds.index, range_max, time, origins, directions]
    wp.launch(cast_kernel, directions.shape, inputs=inputs, outputs=[ranges], device=worlds.device)
    return ranges
