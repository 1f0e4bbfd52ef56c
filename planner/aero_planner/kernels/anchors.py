"""Anchors: M_h x M_v directions around the goal's, moved to the safe direction of their coarse cell."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.dynamics import heading, quat_from_heading, quat_inverse_rotate, quat_rotate
from aero_planner.kernels.params import Params
from aero_planner.kernels.partition import cell_of_direction, safest_fine_cell

__all__ = ["lookahead", "place_anchors", "safe_anchor"]

wp.set_module_options({"enable_backward": False})


@wp.func
def lookahead(speed: float, goal_distance: float, horizon: float, params: Params) -> float:
    """l [m]: tied to the speed, and never beyond the goal.

    A guide of length 0.6 T v that ends at rest asks for no change of the speed v, so this bounds the speed as well.
    """
    steady = 0.6 * horizon
    length = wp.min(params.lookahead, steady * params.speed_limit)
    if params.lookahead_rest < params.lookahead:
        length = wp.min(length, params.lookahead_rest + steady * speed)
    return wp.min(length, goal_distance)


@wp.kernel
def place_anchors(
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion_in: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity_in: wp.array(dtype=wp.vec3),
    goal_quaternion_in: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    columns: int,
    rows: int,
    steps: int,
    quaternion: wp.array(dtype=wp.vec4),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    reach: wp.array(dtype=float),
    initial_direction: wp.array2d(dtype=wp.vec3),
    initial_endpoint: wp.array2d(dtype=wp.vec3),
):
    """Initial endpoints p0 + l d, with d spaced around the goal's azimuth and elevation in the world.

    `reach` is l, `initial_direction` is d in the body frame. The first anchor's thread also normalises the attitudes
    and derives what the goal leaves open; see `Goal`. Launched over [B, M_h M_v].
    """
    b, m = wp.tid()
    p = position[b]
    q = wp.normalize(quaternion_in[b])
    to_goal = goal_position[b] - p
    distance = wp.length(to_goal)
    speed = wp.length(velocity[b])
    length = lookahead(speed, distance, float(steps) * params[b].dt, params[b])
    if m == 0:
        reach[b] = length
        quaternion[b] = q
        v_goal = goal_velocity_in[b]
        if wp.isnan(v_goal[0]):
            v_goal = wp.vec3(0.0, 0.0, 0.0)
        goal_velocity[b] = v_goal
        q_goal = goal_quaternion_in[b]
        if wp.isnan(q_goal[0]):
            yaw = heading(q)
            if to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1] > 0.25:
                yaw = wp.atan2(to_goal[1], to_goal[0])
            q_goal = quat_from_heading(yaw)
        goal_quaternion[b] = wp.normalize(q_goal)
    if distance < 1.0e-3:
        to_goal = quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    spacing = wp.radians(params[b].spacing)
    if speed < params[b].slow_speed:
        spacing = spacing * params[b].slow_spread
    azimuth = wp.atan2(to_goal[1], to_goal[0]) + (float(m % columns) - 0.5 * float(columns - 1)) * spacing
    elevation = wp.atan2(to_goal[2], wp.sqrt(to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1]))
    elevation = elevation + (float(m // columns) - 0.5 * float(rows - 1)) * spacing
    c = wp.cos(elevation)
    d = wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))
    initial_direction[b, m] = quat_inverse_rotate(q, d)
    initial_endpoint[b, m] = p + length * d


@wp.func
def safe_anchor(
    b: int,
    m: int,
    position: wp.vec3,
    quaternion: wp.vec4,
    refine: int,
    fine_range: wp.array2d(dtype=float),
    directions: wp.array2d(dtype=wp.vec3),
    reach: wp.array(dtype=float),
    initial_direction: wp.array2d(dtype=wp.vec3),
    pool: int,
    coarse_rows: int,
    coarse_columns: int,
) -> wp.vec3:
    """Refined endpoint p0 + l d, with d the safe direction of the coarse cell."""
    d = initial_direction[b, m]
    if refine != 0:
        row, column = cell_of_direction(d, coarse_rows, coarse_columns)
        _r, d = safest_fine_cell(fine_range, directions, b, row, column, pool, initial_direction[b, m])
    return position + reach[b] * quat_rotate(quaternion, d)
