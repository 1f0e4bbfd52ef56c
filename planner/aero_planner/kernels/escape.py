"""Places without progress toward the goal: they are remembered, and rollouts that end near them cost more."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params

wp.set_module_options({"enable_backward": False})

PLACES = wp.constant(16)
"""Number of places that are remembered; a new one replaces the oldest."""


@wp.struct
class Escape:
    """Memory of a drone's places without progress."""

    places: wp.array2d(dtype=wp.vec3)  # [B, PLACES], world frame [m]
    count: wp.array(dtype=int)  # [B], number of places since the goal was set
    goal: wp.array(dtype=wp.vec3)  # [B], goal for which the memory holds [m]
    nearest: wp.array(dtype=float)  # [B], distance to the goal when progress was last made [m]
    idle: wp.array(dtype=float)  # [B], time since then, or since the last place was remembered [s]


@wp.func
def escape_depth(p: wp.vec3, b: int, escape: Escape, params: Params) -> float:
    """Return the sum of the depths of p in the neighbourhoods of the remembered places [m]; 0 if these have no weight.

    It fades out within half a radius of the goal: a drone that has passed its goal must be able to come back.
    """
    depth = float(0.0)
    if params.q_escape > 0.0:
        for k in range(wp.min(escape.count[b], PLACES)):
            depth += wp.max(0.0, params.radius - wp.length(p - escape.places[b, k]))
        depth *= wp.min(1.0, 2.0 * wp.length(p - escape.goal[b]) / params.radius)
    return depth


@wp.func
def escape_cost(p: wp.vec3, b: int, escape: Escape, params: Params) -> float:
    """Return the cost of a rollout that ends at p: q_escape times its depth.

    It fades out where p is nearer to the goal than the drone has been: what leads there is a way out, although it may
    end within the neighbourhood of the places in front of a wall.
    """
    share = wp.clamp(1.0 + (wp.length(p - escape.goal[b]) - escape.nearest[b]) / params.ahead, 0.0, 1.0)
    return params.q_escape * share * escape_depth(p, b, escape, params)


@wp.func
def remember_place(b: int, p: wp.vec3, goal: wp.vec3, period: float, escape: Escape, params: Params):
    """Remember the position p if the drone has made no progress for a while; forget all places for a new goal.

    Of a slow drone, no more progress is asked than a third of what its speed limit allows in that time.
    """
    count = escape.count[b]
    nearest = escape.nearest[b]
    idle = escape.idle[b] + period
    distance = wp.length(goal - p)
    progress = wp.min(params.progress, params.speed_limit * params.patience / 3.0)
    if not (wp.length(goal - escape.goal[b]) < 0.1):
        escape.goal[b] = goal
        count = 0
        nearest = distance
        idle = 0.0
    elif distance < nearest - progress:
        nearest = distance
        idle = 0.0
    elif idle > params.patience:
        escape.places[b, count % PLACES] = p
        count += 1
        idle = 0.0
    escape.count[b] = count
    escape.nearest[b] = nearest
    escape.idle[b] = idle
