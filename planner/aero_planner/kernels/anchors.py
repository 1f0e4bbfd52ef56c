"""Anchors: M_h x M_v directions around the goal direction, each moved to the safe direction of its coarse cell."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.hook_records import Spread
from aero_planner.device.params import Params
from aero_planner.device.records import Cells, PreviousPlan, Problem, Start
from aero_planner.device.rotations import heading, quat_from_heading, quat_inverse_rotate, quat_rotate
from aero_planner.kernels.partition import COLUMNS, ROWS, cell_of_direction, longest_lookahead, safest_fine_cell
from aero_planner.kernels.prediction import UNSTAMPED_PERIOD, flown_controls, time_since_plan

wp.set_module_options({"enable_backward": False})

_GUIDE_MARGIN = wp.constant(0.2)
"""Distance from the end of a clipped guide to the range of its fine cell [m]."""
_SHORTEST_GUIDE = wp.constant(0.6)
"""Smallest length of a clipped guide [m]."""


@wp.func
def lookahead(goal_distance: float, horizon: float, params: Params) -> float:
    """Return the look-ahead l [m], which never exceeds the distance to the goal.

    A guide of length 0.6 T v that ends at rest asks for no change of the speed v, so the look-ahead bounds the speed.
    """
    return wp.min(wp.min(longest_lookahead(params), 0.6 * horizon * params.speed_limit), goal_distance)


@functools.cache
def place_anchors(composition: Composition) -> wp.Kernel:
    """Return the kernel that places the initial endpoints and completes the problem."""
    Views, spread_anchors = composition.Views, composition.hooks.spread
    controls_in_effect = flown_controls(composition.model)

    @wp.kernel(module="unique", enable_backward=False)
    def place_anchors(
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        columns: int,
        rows: int,
        steps: int,
        # in
        previous: PreviousPlan,
        views: Views,
        # in (state) and out
        start: Start,
        # out
        initial_directions: wp.array2d(dtype=wp.vec3),
        initial_endpoints: wp.array2d(dtype=wp.vec3),
    ):
        """Place the initial endpoints p0 + l d, with d spaced around azimuth and elevation of the goal in the world.

        `initial_directions` are d in the body frame. The thread of the first anchor also finds the controls in effect
        and derives the velocity and attitude that the goal leaves open; see `Goal`. Launched over [B, M_h M_v].
        """
        b, m = wp.tid()
        p = start.position[b]
        q = start.quaternion[b]
        to_goal = problem.goal[b] - p
        distance = wp.length(to_goal)
        speed = wp.length(start.velocity[b])
        length = lookahead(distance, float(steps) * params[b].dt, params[b])
        spread = Spread()
        spread.p = p
        spread.speed = speed
        spread.columns = 1.0
        spread.rows = 1.0
        spread.clip = 0
        spread = spread_anchors(b, spread, views, params[b])
        if m == 0:
            start.lookahead[b] = length
            start.clip_guides[b] = spread.clip
            since = time_since_plan(b, problem.time[b], previous, params[b])
            commanded, in_effect = controls_in_effect(b, since, previous, params[b])
            start.command[b] = commanded
            start.control[b] = in_effect
            start.period[b] = wp.where(since > 0.0, since, UNSTAMPED_PERIOD)
            v_goal = problem.goal_velocity[b]
            if wp.isnan(v_goal[0]):
                v_goal = wp.vec3(0.0, 0.0, 0.0)
            start.goal_velocity[b] = v_goal
            q_goal = problem.goal_quaternion[b]
            if wp.isnan(q_goal[0]):
                yaw = heading(q)
                if to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1] > 0.25:
                    yaw = wp.atan2(to_goal[1], to_goal[0])
                q_goal = quat_from_heading(yaw)
            start.goal_quaternion[b] = wp.normalize(q_goal)
        if distance < 1.0e-3:
            to_goal = quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
        spacing = wp.radians(params[b].spacing)
        azimuth = wp.atan2(to_goal[1], to_goal[0])
        azimuth = azimuth + (float(m % columns) - 0.5 * float(columns - 1)) * spacing * spread.columns
        elevation = wp.atan2(to_goal[2], wp.sqrt(to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1]))
        elevation = elevation + (float(m // columns) - 0.5 * float(rows - 1)) * spacing * spread.rows
        c = wp.cos(elevation)
        d = wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))
        initial_directions[b, m] = quat_inverse_rotate(q, d)
        initial_endpoints[b, m] = p + length * d

    return place_anchors


@functools.cache
def safe_anchor(lanes: int) -> wp.Function:
    """Return the function that refines an anchor, which `lanes` lanes of a warp share."""
    safest = safest_fine_cell(lanes)

    @wp.func
    def safe_anchor(
        b: int, m: int, lane: int, start: Start, cells: Cells, initial_directions: wp.array2d(dtype=wp.vec3)
    ) -> wp.vec3:
        """Return the refined endpoint p0 + l d, with d the safe direction of the coarse cell [m], world frame.

        With `clip_guides`, it is nearer than what its fine cell measured.
        """
        toward = initial_directions[b, m]
        row, column = cell_of_direction(toward, ROWS, COLUMNS)
        free, d = safest(cells, b, lane, row, column, toward)
        length = start.lookahead[b]
        if start.clip_guides[b] != 0:
            length = wp.min(length, wp.max(free - _GUIDE_MARGIN, _SHORTEST_GUIDE))
        return start.position[b] + length * quat_rotate(start.quaternion[b], d)

    return safe_anchor
