"""Partition of the cloud into cells, filtered cloud, safe directions and anchors."""

from __future__ import annotations

import warp as wp

from benchmarks.naive.arrays import Arrays
from benchmarks.naive.model import follow_command, rotate, rotate_back, yaw

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
def complete_goal(a: Arrays):
    """Normalise the attitudes, find the command and the control in effect if the previous plan was flown, and complete
    the goal, as `aero_planner.Goal` says. Launched over [B].
    """
    b = wp.tid()
    a.q0[b] = wp.normalize(a.quaternion[b])
    c = a.params[b]
    command = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
    control = command
    left = float(a.time[b] - a.previous_time[b])
    if wp.isnan(a.time[b]) and not wp.isnan(a.previous_time[b]):
        left = c.replan_period
    if left >= 0.0 and left < float(a.nominal.shape[2]) * c.dt:
        control = a.previous_start_control[b]
        for t in range(a.nominal.shape[2]):
            if left >= 0.0:
                command = a.previous_controls[b, t]
                _mean, control = follow_command(control, command, wp.min(left, c.dt), c)
                left -= c.dt
    a.command[b] = command
    a.control[b] = control
    a.v_goal[b] = a.goal_velocity[b]
    if wp.isnan(a.goal_velocity[b][0]):
        a.v_goal[b] = wp.vec3(0.0, 0.0, 0.0)
    a.q_goal[b] = wp.normalize(a.goal_quaternion[b])
    if wp.isnan(a.goal_quaternion[b][0]):
        way = a.goal_position[b] - a.position[b]
        angle = yaw(a.q0[b])
        if wp.length(wp.vec2(way[0], way[1])) > 0.5:
            angle = wp.atan2(way[1], way[0])
        a.q_goal[b] = wp.vec4(wp.cos(0.5 * angle), 0.0, 0.0, wp.sin(0.5 * angle))


@wp.kernel
def cells_of_points(a: Arrays):
    """Find the minimum (range, index) of each cell as one packed number. Launched over [B, P]."""
    b, i = wp.tid()
    rows = a.coarse_rows * a.fine_cells
    columns = a.coarse_columns * a.fine_cells
    if i >= a.point_count[b]:
        return
    x = a.points[b, i]
    if not (wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])):
        wp.atomic_add(a.dropped, b, 1)
        return
    r = wp.length(x - a.position[b])
    if r > a.params[b].range_max or r < a.params[b].range_min:
        return
    row, column = cell_of(rotate_back(a.q0[b], x - a.position[b]), rows, columns)
    key = (wp.uint64(wp.cast(r, wp.uint32)) << wp.uint64(32)) | wp.uint64(i)
    wp.atomic_min(a.keys, b, row * columns + column, key)


@wp.kernel
def fine_cells(a: Arrays):
    """Write r_ij, and the filtered cloud as a list in any order. Launched over [B, fine cells]."""
    b, cell = wp.tid()
    a.fine_range[b, cell] = a.params[b].range_max
    key = a.keys[b, cell]
    if key != NOTHING:
        a.fine_range[b, cell] = wp.cast(wp.uint32(key >> wp.uint64(32)), float)
        a.filtered[b, wp.atomic_add(a.count, b, 1)] = a.points[b, int(key & wp.uint64(0xFFFFFFFF))]


@wp.func
def safest(a: Arrays, b: int, row: int, column: int, toward: wp.vec3):
    """Return the largest range in a coarse cell, and its direction.

    Among equal ranges it is the direction nearest to `toward`, and the first of several within 1e-6.
    """
    pool = a.fine_cells
    rows = a.coarse_rows * pool
    columns = a.coarse_columns * pool
    best_range = float(-1.0)
    best_cosine = float(-2.0)
    best_direction = wp.vec3(0.0, 0.0, 0.0)
    for i in range(row * pool, row * pool + pool):
        for j in range(column * pool, column * pool + pool):
            r = a.fine_range[b, i * columns + j]
            d = center_of(i, j, rows, columns)
            cosine = wp.dot(d, toward)
            if r > best_range or (r == best_range and cosine > best_cosine + 1.0e-6):
                best_range = r
                best_cosine = cosine
                best_direction = d
    return best_range, best_direction


@wp.kernel
def initial_anchors(a: Arrays):
    """Write the look-ahead l and the M_h x M_v initial directions, body frame. Launched over [B, M_h M_v]."""
    b, m = wp.tid()
    c = a.params[b]
    rows = a.anchor_rows
    columns = a.anchor_columns
    way = a.goal_position[b] - a.position[b]
    distance = wp.length(way)
    if distance < 1.0e-3:
        way = rotate(a.q0[b], wp.vec3(1.0, 0.0, 0.0))
    speed = wp.length(a.velocity[b])
    T = float(a.nominal.shape[2]) * c.dt
    length = wp.min(wp.min(c.lookahead, 0.6 * T * c.speed_limit), distance)
    if c.lookahead_rest < c.lookahead:
        length = wp.min(length, c.lookahead_rest + 0.6 * T * speed)
    a.reach[b] = length
    spacing = wp.radians(c.spacing)
    rise = spacing
    if speed < c.slow_speed:
        share = float(a.tick[b] % c.slow_cycle + 1) / float(c.slow_cycle)
        rise = spacing * (1.0 + (c.slow_rise - 1.0) * share)
        spacing = spacing * (1.0 + (c.slow_spread - 1.0) * share)
    azimuth = wp.atan2(way[1], way[0]) + (float(m % columns) - 0.5 * float(columns - 1)) * spacing
    elevation = wp.atan2(way[2], wp.sqrt(way[0] * way[0] + way[1] * way[1]))
    elevation = elevation + (float(m // columns) - 0.5 * float(rows - 1)) * rise
    a.direction[b, m] = rotate_back(
        a.q0[b], wp.vec3(wp.cos(elevation) * wp.cos(azimuth), wp.cos(elevation) * wp.sin(azimuth), wp.sin(elevation))
    )


@wp.kernel
def coarse_cells(a: Arrays):
    """Find the safe direction of each coarse cell, ties toward its first anchor or its centre. Launched over [B, C]."""
    b, cell = wp.tid()
    rows = a.coarse_rows
    columns = a.coarse_columns
    row = cell // columns
    column = cell % columns
    toward = center_of(row, column, rows, columns)
    found = int(0)
    for m in range(a.direction.shape[1]):
        r, c = cell_of(a.direction[b, m], rows, columns)
        if r == row and c == column and found == 0:
            toward = a.direction[b, m]
            found = 1
    best_range, best_direction = safest(a, b, row, column, toward)
    a.safe_range[b, cell] = best_range
    a.safe_direction[b, cell] = best_direction


@wp.kernel
def refined_anchors(a: Arrays):
    """Write p0 + l d with d the safe direction of the anchor's coarse cell. Launched over [B, M_h M_v]."""
    b, m = wp.tid()
    d = a.direction[b, m]
    if a.params[b].refine != 0:
        row, column = cell_of(d, a.coarse_rows, a.coarse_columns)
        _r, d = safest(a, b, row, column, d)
    a.anchor[b, m] = a.position[b] + a.reach[b] * rotate(a.q0[b], d)
