"""Tabu memory of local minima: places without progress are remembered, and rollouts that end near them cost more."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.costs.cost_term import End
from aero_planner.device.hook_records import Spread
from aero_planner.device.params import Params
from aero_planner.device.records import PreviousPlan, Problem
from aero_planner.kernels.prediction import UNSTAMPED_PERIOD, time_since_plan

wp.set_module_options({"enable_backward": False})

PLACES = wp.constant(16)
"""Number of places that are remembered; a new one replaces the oldest."""
_PROGRESS = wp.constant(0.3)
"""Decrease of the distance to the goal that counts as progress, at most [m]."""
_ARRIVED = wp.constant(1.0)
"""Distance within which the drone has been at its goal [m]."""
_AHEAD = wp.constant(2.0)
"""Distance by which a rollout must end nearer to the goal than the drone has been to cost nothing [m]."""
_SLOW = wp.constant(3.0)
"""Speed below which the drone looks around [m/s]."""


@wp.struct
class Places:
    """Tabu memory of each drone."""

    places: wp.array2d(dtype=wp.vec3)  # [B, PLACES], world frame [m]
    place_count: wp.array(dtype=int)  # [B], number of places since the goal was set
    place_goal: wp.array(dtype=wp.vec3)  # [B], goal for which the memory holds [m]
    place_nearest: wp.array(dtype=float)  # [B], distance to the goal at the last progress [m]; 0 after an arrival
    place_idle: wp.array(dtype=float)  # [B], time since then, or since the last place was remembered [s]


@wp.func
def escape_depth(p: wp.vec3, b: int, memory: Places, radius: float) -> float:
    """Return the sum of the depths of p in the neighbourhoods of the remembered places [m].

    It fades out within half a radius of the goal: a drone that has passed its goal must be able to come back.
    """
    depth = float(0.0)
    for k in range(wp.min(memory.place_count[b], PLACES)):
        depth += wp.max(0.0, radius - wp.length(p - memory.places[b, k]))
    return depth * wp.min(1.0, 2.0 * wp.length(p - memory.place_goal[b]) / radius)


@wp.func
def escape_cost(e: End, views: Any, c: Any) -> float:
    """Return q_escape times the depth of the end of a rollout.

    It fades out where that end is nearer to the goal than the drone has been: what leads there is a way out, although
    it may end within the neighbourhood of the places in front of a wall.
    """
    cost = float(0.0)
    if c.q_escape > 0.0:
        nearer = views.way_out.place_nearest[e.b] - wp.length(e.p - views.way_out.place_goal[e.b])
        share = wp.clamp(1.0 - nearer / _AHEAD, 0.0, 1.0)
        cost = c.q_escape * share * escape_depth(e.p, e.b, views.way_out, c.radius)
    return cost


@wp.func
def look_around(b: int, s: Spread, views: Any, c: Any) -> Spread:
    """Spread the anchors of a slow drone, and end its guides in front of surfaces near a remembered place.

    A guide through a wall does not lead out of a dead end.
    """
    if s.speed < _SLOW:
        s.columns *= c.spread
        s.rows *= 1.0 + 1.5 * (c.spread - 1.0)  # the way out may lead over the obstacle
        if c.q_escape > 0.0 and escape_depth(s.p, b, views.way_out, c.radius) > 0.0:
            s.clip = 1
    return s


@wp.kernel
def remember_place(
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    # in
    previous: PreviousPlan,
    # in and out
    memory: Places,
):
    """Remember the position if the drone has made no progress for a while; forget all places for a new goal.

    Of a slow drone, no more progress is asked than a third of what its speed limit allows in that time. One that has
    been at its goal makes no more progress and remembers nothing: it must be able to stay, or to come back. Launched
    over [B].
    """
    b = wp.tid()
    c = params[b]
    if c.q_escape == 0.0:
        return
    since = time_since_plan(b, problem.time[b], previous, c)
    p = problem.position[b]
    goal = problem.goal[b]
    count = memory.place_count[b]
    nearest = memory.place_nearest[b]
    idle = memory.place_idle[b] + wp.where(since > 0.0, since, UNSTAMPED_PERIOD)
    distance = wp.length(goal - p)
    if not (wp.length(goal - memory.place_goal[b]) < 0.1):
        memory.place_goal[b] = goal
        count = 0
        nearest = distance
        idle = 0.0
    elif distance < _ARRIVED:
        count = 0
        nearest = 0.0
    elif distance < nearest - wp.min(_PROGRESS, c.speed_limit * c.patience / 3.0):
        nearest = distance
        idle = 0.0
    elif idle > c.patience and nearest > 0.0:
        memory.places[b, count % PLACES] = p
        count += 1
        idle = 0.0
    memory.place_count[b] = count
    memory.place_nearest[b] = nearest
    memory.place_idle[b] = idle
