"""Tabu memory of local minima: places without progress are remembered, and rollouts that end near them cost more."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.costs.cost_term import End
from aero_planner.device.hook_records import Spread
from aero_planner.device.params import Params
from aero_planner.device.records import Cells, PreviousPlan, Problem
from aero_planner.device.rotations import quat_inverse_rotate
from aero_planner.kernels.partition import cell_of_direction
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
_SIDES = wp.constant(12)
"""Directions, of 30 deg each, from which a goal is looked at."""
_HIDDEN_NOW = wp.constant(1 << 12)
"""Bit for the direction from which it was looked at last."""
_RESIGNED = wp.constant(2.0)
"""Time without progress after which a drone within `_ARRIVED` of a goal behind a surface holds its place [s]."""
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
    goal_hidden: wp.array(dtype=int)  # [B], bit i: from direction i, the goal was behind a surface; then `_HIDDEN_NOW`


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
    nearest_place: wp.array(dtype=wp.vec3),
):
    """Remember the position if the drone has made no progress for a while; forget all places for a new goal.

    Of a slow drone, no more progress is asked than a third of what its speed limit allows in that time. One that has
    been at its goal makes no more progress and remembers nothing: it must be able to stay, or to come back. One to
    whose goal no way leads, since it lies behind a surface from all directions, flies to where it was nearest to it,
    and stays. Launched over [B].
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
    hidden = memory.goal_hidden[b]
    no_way = (hidden & (_HIDDEN_NOW - 1)) == _HIDDEN_NOW - 1
    if nearest == 0.0 and idle > _RESIGNED and (hidden & _HIDDEN_NOW) != 0:
        no_way = True
    if not (wp.length(goal - memory.place_goal[b]) < 0.1):
        memory.place_goal[b] = goal
        memory.goal_hidden[b] = 0
        nearest_place[b] = p
        count = 0
        nearest = distance
        idle = 0.0
    elif distance < _ARRIVED or no_way:
        count = 0
        nearest = 0.0
    elif distance < nearest - wp.min(_PROGRESS, c.speed_limit * c.patience / 3.0):
        nearest = distance
        idle = 0.0
    elif idle > c.patience and nearest > 0.0:
        memory.places[b, count % PLACES] = p
        count += 1
        idle = 0.0
    if distance < wp.length(goal - nearest_place[b]):
        nearest_place[b] = p
    if nearest == 0.0 and no_way:
        problem.goal[b] = nearest_place[b]
    memory.place_count[b] = count
    memory.place_nearest[b] = nearest
    memory.place_idle[b] = idle


@wp.kernel
def look_at_goal(
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    # in
    cells: Cells,
    # in and out
    memory: Places,
):
    """Note whether the goal lies behind the nearest point of its fine cell. Launched over [B]."""
    b = wp.tid()
    if params[b].q_escape == 0.0:
        return
    to_goal = memory.place_goal[b] - problem.position[b]
    toward = quat_inverse_rotate(wp.normalize(problem.quaternion[b]), to_goal)
    row, column = cell_of_direction(toward, cells.rows, cells.columns)
    cell = row * cells.columns + column
    memory.goal_hidden[b] = memory.goal_hidden[b] & (_HIDDEN_NOW - 1)
    if cells.occupied[b, cell] != 0 and cells.range[b, cell] < wp.length(to_goal):
        turn = wp.atan2(to_goal[1], to_goal[0]) / (2.0 * wp.PI) + 0.5
        side = wp.clamp(int(turn * float(_SIDES)), 0, _SIDES - 1)
        memory.goal_hidden[b] = memory.goal_hidden[b] | (1 << side) | _HIDDEN_NOW
