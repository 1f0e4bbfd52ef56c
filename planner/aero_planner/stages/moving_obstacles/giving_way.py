"""Whether a candidate gives way to the dynamic obstacles, rather than fly along beside one of the same speed."""

# Postponed annotations are left out: native functions need the types themselves.

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

_BESIDE = wp.constant(4.0)
"""Distance from the surface of an obstacle up to which a drone is beside it, or follows it [m]."""
_ALONG = wp.constant(0.5)
"""Part of an obstacle's way by which the way of a drone that flies along differs from it, at most."""
_PROGRESS = wp.constant(0.5)
"""Part of a candidate's way that it comes nearer to the goal, at least, if it is worth flying along."""


@wp.struct
class MovingObstacles:
    """What the hooks read: the tracks, dynamic obstacles at the start of the plan, and the candidates."""

    track_time: wp.array(dtype=wp.float64)  # as in `tracks.Tracks`, like the next four
    track_count: wp.array(dtype=int)
    track_position: wp.array2d(dtype=wp.vec2)
    track_velocity: wp.array2d(dtype=wp.vec2)
    track_radius: wp.array2d(dtype=float)
    dynamic_count: wp.array(dtype=int)  # as in `tracks.DynamicObstacles`, like the next three
    dynamic_position: wp.array2d(dtype=wp.vec2)
    dynamic_velocity: wp.array2d(dtype=wp.vec2)
    dynamic_radius: wp.array2d(dtype=float)
    positions: wp.array3d(dtype=wp.vec3)  # as in `Rollouts`
    goal_position: wp.array(dtype=wp.vec3)  # `given_goal` of `Problem`


@wp.func
def gives_way(b: int, m: int, is_admissible: int, views: Any, c: Any) -> int:
    """Return 0 for an instance that flies along beside a dynamic obstacle without approach to the goal.

    Where an obstacle as fast as the drone crosses its way, each plan that flies on beside it is clear, and no worse
    than the one before. Without such plans, the drone stops and lets the obstacle pass. See `Hooks.admissible`.
    """
    view = views.moving_obstacles
    last = view.positions.shape[2] - 1
    duration = float(last) * c.dt
    start = view.positions[b, m, 0]
    end = view.positions[b, m, last]
    goal = view.goal_position[b]
    approach = wp.length(goal - start) - wp.length(goal - end)
    way = wp.vec2(end[0] - start[0], end[1] - start[1])
    result = is_admissible
    if approach < _PROGRESS * wp.length(way):
        for i in range(view.dynamic_count[b]):
            offset = wp.vec2(start[0], start[1]) - view.dynamic_position[b, i]
            its_way = duration * view.dynamic_velocity[b, i]
            farthest = wp.max(wp.length(offset), wp.length(offset + way - its_way))
            is_beside = farthest - view.dynamic_radius[b, i] < _BESIDE
            if is_beside and wp.length(way - its_way) < _ALONG * wp.length(its_way):
                result = 0
    return result
