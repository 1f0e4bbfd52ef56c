"""Anchors: M_h x M_v directions around the goal direction, each moved to the safe direction of its coarse cell."""

# Postponed annotations are left out: functions made for a tuning refer to local types.

import functools

import warp as wp

from aero_planner.kernels.dynamics import (
    heading,
    lag_shares,
    lagged_control,
    quat_from_heading,
    quat_inverse_rotate,
    quat_rotate,
)
from aero_planner.kernels.escape import Escape, escape_depth
from aero_planner.kernels.params import Params
from aero_planner.kernels.partition import cell_of_direction, safest_fine_cell
from aero_planner.kernels.records import DroneState, GoalState, PreviousPlan

wp.set_module_options({"enable_backward": False})


@wp.func
def lookahead(speed: float, goal_distance: float, horizon: float, params: Params) -> float:
    """Return the look-ahead l [m], which depends on the speed and never exceeds the distance to the goal.

    A guide of length 0.6 T v that ends at rest asks for no change of the speed v, so the look-ahead bounds the speed.
    """
    steady = 0.6 * horizon
    longest = wp.max(params.lookahead, params.lookahead_time * params.speed_limit)
    length = wp.min(longest, steady * params.speed_limit)
    if params.lookahead_rest < longest:
        length = wp.min(length, params.lookahead_rest + steady * speed)
    return wp.min(length, goal_distance)


@wp.func
def time_since_plan(b: int, time: wp.float64, previous: PreviousPlan, params: Params) -> float:
    """Return the time since the previous plan [s]; NaN if there is none."""
    # The difference is taken in float64, since stamps may count from 1970.
    elapsed = float(time - previous.time[b])
    if wp.isnan(time) and not wp.isnan(previous.time[b]):
        elapsed = params.replan_period
    return elapsed


@wp.func
def flown_controls(b: int, elapsed: float, previous: PreviousPlan, params: Params):
    """Return the command and the control in effect when the previous plan has been flown for a time; hover if not."""
    command = wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)
    control = command
    steps = previous.controls.shape[1]
    if elapsed >= 0.0 and elapsed < float(steps) * params.dt:
        control = previous.start_control[b]
        shares = lag_shares(params.dt, params)
        whole = int(elapsed / params.dt)
        for t in range(whole):
            control = lagged_control(previous.controls[b, t], control, shares)
        rest = lag_shares(elapsed - float(whole) * params.dt, params)
        command = previous.controls[b, wp.min(whole, steps - 1)]
        control = lagged_control(command, control, rest)
    return command, control


@wp.kernel
def place_anchors(
    # problem; the goal may be incomplete
    drone: DroneState,
    time: wp.array(dtype=wp.float64),
    goal: GoalState,
    # configuration
    params: wp.array(dtype=Params),
    columns: int,
    rows: int,
    steps: int,
    # in
    tick: wp.array(dtype=int),
    escape: Escape,
    previous: PreviousPlan,
    # out
    command: wp.array(dtype=wp.vec4),
    control: wp.array(dtype=wp.vec4),
    full_goal: GoalState,
    lookahead_length: wp.array(dtype=float),
    clip_guides: wp.array(dtype=int),
    initial_directions: wp.array2d(dtype=wp.vec3),
    initial_endpoints: wp.array2d(dtype=wp.vec3),
):
    """Place the initial endpoints p0 + l d, with d spaced around the azimuth and elevation of the goal in the world.

    `initial_directions` are d in the body frame. A slow drone near remembered places gets other rows of anchors and
    shorter guides; see `EscapeConfig`. The thread of the first anchor also finds the controls in effect and derives the
    velocity and attitude that the goal leaves open; see `Goal`. Launched over [B, M_h M_v].
    """
    b, m = wp.tid()
    p = drone.position[b]
    q = drone.quaternion[b]
    to_goal = goal.position[b] - p
    distance = wp.length(to_goal)
    speed = wp.length(drone.velocity[b])
    length = lookahead(speed, distance, float(steps) * params[b].dt, params[b])
    is_slow = speed < params[b].slow_speed
    depth = float(0.0)
    if is_slow:
        depth = escape_depth(p, b, escape, params[b])
    if m == 0:
        lookahead_length[b] = length
        clip_guides[b] = wp.where(depth > params[b].guide_depth, 1, 0)
        commanded, in_effect = flown_controls(b, time_since_plan(b, time[b], previous, params[b]), previous, params[b])
        command[b] = commanded
        control[b] = in_effect
        v_goal = goal.velocity[b]
        if wp.isnan(v_goal[0]):
            v_goal = wp.vec3(0.0, 0.0, 0.0)
        full_goal.velocity[b] = v_goal
        q_goal = goal.quaternion[b]
        if wp.isnan(q_goal[0]):
            yaw = heading(q)
            if to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1] > 0.25:
                yaw = wp.atan2(to_goal[1], to_goal[0])
            q_goal = quat_from_heading(yaw)
        full_goal.quaternion[b] = wp.normalize(q_goal)
    if distance < 1.0e-3:
        to_goal = quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    spacing = wp.radians(params[b].spacing)
    rise = spacing
    if is_slow:
        share = float(tick[b] % params[b].slow_cycle + 1) / float(params[b].slow_cycle)
        factor = wp.where(depth > 0.0, params[b].rise, params[b].slow_rise)
        rise = spacing * (1.0 + (factor - 1.0) * share)
        spacing = spacing * (1.0 + (params[b].slow_spread - 1.0) * share)
    azimuth = wp.atan2(to_goal[1], to_goal[0]) + (float(m % columns) - 0.5 * float(columns - 1)) * spacing
    elevation = wp.atan2(to_goal[2], wp.sqrt(to_goal[0] * to_goal[0] + to_goal[1] * to_goal[1]))
    elevation = elevation + (float(m // columns) - 0.5 * float(rows - 1)) * rise
    c = wp.cos(elevation)
    d = wp.vec3(c * wp.cos(azimuth), c * wp.sin(azimuth), wp.sin(elevation))
    initial_directions[b, m] = quat_inverse_rotate(q, d)
    initial_endpoints[b, m] = p + length * d


@functools.cache
def safe_anchor(lanes: int) -> wp.Function:
    """Return the function that refines an anchor, which `lanes` lanes of a warp share."""
    safest = safest_fine_cell(lanes)

    @wp.func
    def safe_anchor(
        b: int,
        m: int,
        lane: int,
        position: wp.vec3,
        quaternion: wp.vec4,
        params: Params,
        fine_cells: int,
        coarse_rows: int,
        coarse_columns: int,
        fine_range: wp.array2d(dtype=float),
        directions: wp.array2d(dtype=wp.vec3),
        length: float,
        clip: int,
        initial_directions: wp.array2d(dtype=wp.vec3),
    ) -> wp.vec3:
        """Return the refined endpoint p0 + l d, with d the safe direction of the coarse cell [m], world frame.

        With `clip`, it is `guide_margin` nearer than what its fine cell measured, but no nearer than `guide_min`.
        """
        d = initial_directions[b, m]
        free = float(0.0)
        if params.refine != 0:
            row, column = cell_of_direction(d, coarse_rows, coarse_columns)
            free, d = safest(fine_range, directions, b, lane, row, column, fine_cells, initial_directions[b, m])
        elif clip != 0:
            fine_row, fine_column = cell_of_direction(d, directions.shape[0], directions.shape[1])
            free = fine_range[b, fine_row * directions.shape[1] + fine_column]
        if clip != 0:
            length = wp.min(length, wp.max(free - params.guide_margin, params.guide_min))
        return position + length * quat_rotate(quaternion, d)

    return safe_anchor
