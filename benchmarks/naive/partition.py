"""Partition of the cloud into cells, filtered cloud, safe directions and anchors."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params
from benchmarks.naive.model import rotate, rotate_back, yaw

__all__ = ["cells_of_points", "coarse_cells", "complete_goal", "fine_cells", "initial_anchors", "refined_anchors"]

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))


@wp.func
def cell_of(d: wp.vec3, rows: int, columns: int):
    """Return row and column of the cell in direction d."""
    azimuth = wp.atan2(d[1], d[0])
    elevation = wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
    row = int(wp.floor(elevation * (float(rows) / wp.PI) + 0.5 * float(rows)))
    column = int(wp.floor(azimuth * (0.5 * float(columns) / wp.PI) + 0.5 * float(columns)))
    return wp.clamp(row, 0, rows - 1), (column + columns) % columns


@wp.func
def center_of(row: int, column: int, rows: int, columns: int) -> wp.vec3:
    """Return d_ij = (cos b cos a, cos b sin a, sin b) at the centre of a cell."""
    a = ((float(column) + 0.5) / float(columns) - 0.5) * 2.0 * wp.PI
    b = ((float(row) + 0.5) / float(rows) - 0.5) * wp.PI
    return wp.vec3(wp.cos(b) * wp.cos(a), wp.cos(b) * wp.sin(a), wp.sin(b))


@wp.kernel
def complete_goal(
    position: wp.array(dtype=wp.vec3),
    quaternion_in: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity_in: wp.array(dtype=wp.vec3),
    goal_quaternion_in: wp.array(dtype=wp.vec4),
    quaternion: wp.array(dtype=wp.vec4),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
):
    """Normalise the attitudes and complete the goal, as `aero_planner.Goal` says. Launched over [B]."""
    b = wp.tid()
    quaternion[b] = wp.normalize(quaternion_in[b])
    goal_velocity[b] = goal_velocity_in[b]
    if wp.isnan(goal_velocity_in[b][0]):
        goal_velocity[b] = wp.vec3(0.0, 0.0, 0.0)
    goal_quaternion[b] = wp.normalize(goal_quaternion_in[b])
    if wp.isnan(goal_quaternion_in[b][0]):
        way = goal_position[b] - position[b]
        angle = yaw(quaternion[b])
        if wp.length(wp.vec2(way[0], way[1])) > 0.5:
            angle = wp.atan2(way[1], way[0])
        goal_quaternion[b] = wp.vec4(wp.cos(0.5 * angle), 0.0, 0.0, wp.sin(0.5 * angle))


@wp.kernel
def cells_of_points(
    points: wp.array2d(dtype=wp.vec3),
    point_count: wp.array(dtype=int),
    position: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    rows: int,
    columns: int,
    keys: wp.array2d(dtype=wp.uint64),
    dropped: wp.array(dtype=int),
):
    """Find the minimum (range, index) of each cell as one packed number. Launched over [B, P]."""
    b, i = wp.tid()
    if i >= point_count[b]:
        return
    x = points[b, i]
    if not (wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])):
        wp.atomic_add(dropped, b, 1)
        return
    r = wp.length(x - position[b])
    if r > params[b].range_max or r < params[b].range_min:
        return
    row, column = cell_of(rotate_back(quaternion[b], x - position[b]), rows, columns)
    key = (wp.uint64(wp.cast(r, wp.uint32)) << wp.uint64(32)) | wp.uint64(i)
    wp.atomic_min(keys, b, row * columns + column, key)


@wp.kernel
def fine_cells(
    keys: wp.array2d(dtype=wp.uint64),
    points: wp.array2d(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    fine_range: wp.array2d(dtype=float),
    count: wp.array(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
):
    """Write r_ij, and the filtered cloud as a list in any order. Launched over [B, fine cells]."""
    b, cell = wp.tid()
    fine_range[b, cell] = params[b].range_max
    key = keys[b, cell]
    if key != NOTHING:
        fine_range[b, cell] = wp.cast(wp.uint32(key >> wp.uint64(32)), float)
        filtered[b, wp.atomic_add(count, b, 1)] = points[b, int(key & wp.uint64(0xFFFFFFFF))]


@wp.func
def safest(
    fine_range: wp.array2d(dtype=float), b: int, row: int, column: int, pool: int, rows: int, columns: int,
    toward: wp.vec3,
):  # fmt: skip
    """Return the largest range in a coarse cell, and its direction.

    Among equal ranges it is the direction nearest to `toward`, and the first of several within 1e-6.
    """
    best_range = float(-1.0)
    best_cosine = float(-2.0)
    best_direction = wp.vec3(0.0, 0.0, 0.0)
    for i in range(row * pool, row * pool + pool):
        for j in range(column * pool, column * pool + pool):
            r = fine_range[b, i * columns * pool + j]
            d = center_of(i, j, rows * pool, columns * pool)
            cosine = wp.dot(d, toward)
            if r > best_range or (r == best_range and cosine > best_cosine + 1.0e-6):
                best_range = r
                best_cosine = cosine
                best_direction = d
    return best_range, best_direction


@wp.kernel
def initial_anchors(
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    columns: int,
    rows: int,
    steps: int,
    reach: wp.array(dtype=float),
    direction: wp.array2d(dtype=wp.vec3),
):
    """Write the look-ahead l and the M_h x M_v initial directions, body frame. Launched over [B, M_h M_v]."""
    b, m = wp.tid()
    c = params[b]
    way = goal_position[b] - position[b]
    distance = wp.length(way)
    if distance < 1.0e-3:
        way = rotate(quaternion[b], wp.vec3(1.0, 0.0, 0.0))
    speed = wp.length(velocity[b])
    T = float(steps) * c.dt
    length = wp.min(wp.min(c.lookahead, 0.6 * T * c.speed_limit), distance)
    if c.lookahead_rest < c.lookahead:
        length = wp.min(length, c.lookahead_rest + 0.6 * T * speed)
    reach[b] = length
    spacing = wp.radians(c.spacing)
    if speed < c.slow_speed:
        spacing = spacing * c.slow_spread
    azimuth = wp.atan2(way[1], way[0]) + (float(m % columns) - 0.5 * float(columns - 1)) * spacing
    elevation = wp.atan2(way[2], wp.sqrt(way[0] * way[0] + way[1] * way[1]))
    elevation = elevation + (float(m // columns) - 0.5 * float(rows - 1)) * spacing
    direction[b, m] = rotate_back(
        quaternion[b],
        wp.vec3(wp.cos(elevation) * wp.cos(azimuth), wp.cos(elevation) * wp.sin(azimuth), wp.sin(elevation)),
    )


@wp.kernel
def coarse_cells(
    fine_range: wp.array2d(dtype=float),
    direction: wp.array2d(dtype=wp.vec3),
    pool: int,
    rows: int,
    columns: int,
    safe_range: wp.array2d(dtype=float),
    safe_direction: wp.array2d(dtype=wp.vec3),
):
    """Find the safe direction of each coarse cell, ties toward its first anchor or its centre. Launched over [B, C]."""
    b, cell = wp.tid()
    row = cell // columns
    column = cell % columns
    toward = center_of(row, column, rows, columns)
    found = int(0)
    for m in range(direction.shape[1]):
        r, c = cell_of(direction[b, m], rows, columns)
        if r == row and c == column and found == 0:
            toward = direction[b, m]
            found = 1
    best_range, best_direction = safest(fine_range, b, row, column, pool, rows, columns, toward)
    safe_range[b, cell] = best_range
    safe_direction[b, cell] = best_direction


@wp.kernel
def refined_anchors(
    position: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    fine_range: wp.array2d(dtype=float),
    reach: wp.array(dtype=float),
    direction: wp.array2d(dtype=wp.vec3),
    pool: int,
    rows: int,
    columns: int,
    anchor: wp.array2d(dtype=wp.vec3),
):
    """Write p0 + l d with d the safe direction of the anchor's coarse cell. Launched over [B, M_h M_v]."""
    b, m = wp.tid()
    d = direction[b, m]
    if params[b].refine != 0:
        row, column = cell_of(d, rows, columns)
        _r, d = safest(fine_range, b, row, column, pool, rows, columns, d)
    anchor[b, m] = position[b] + reach[b] * rotate(quaternion[b], d)
