"""Stage II: roll out the optimised controls, pick the best instance, and brake where none is safe."""

from __future__ import annotations

import warp as wp

from aero_planner.clearance import PointList, cell_size, clearance_at, row_limit
from aero_planner.costs import goal_cost, speed_cost
from aero_planner.dynamics import rk4_step
from aero_planner.guides import write_brake
from aero_planner.mppi import PROBES, clearance_cost, probe
from aero_planner.params import Params

__all__ = ["brake_where_unsafe", "remember", "roll_out_best", "select"]

wp.set_module_options({"enable_backward": False})

OK = wp.constant(0)
NO_SAFE_CANDIDATE = wp.constant(1)
STALE_CLOUD = wp.constant(2)


@wp.func
def write_position(i: int, row: int, p: wp.vec3, positions: wp.array4d(dtype=float)):
    for axis in range(3):
        positions[i, row, axis, 0] = p[axis]


@wp.func
def roll_out(
    i: int,
    b: int,
    m: int,
    p: wp.vec3,
    v: wp.vec3,
    q: wp.vec4,
    p_goal: wp.vec3,
    v_goal: wp.vec3,
    q_goal: wp.vec4,
    params: Params,
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    velocities: wp.array3d(dtype=wp.vec3),
    quaternions: wp.array3d(dtype=wp.vec4),
    probed: wp.array4d(dtype=float),
):
    """Roll out one instance's controls; writes its states and probes, returns J_goal and the speed's cost."""
    steps = controls.shape[2]
    positions[b, m, 0] = p
    velocities[b, m, 0] = v
    quaternions[b, m, 0] = q
    J_goal = float(0.0)
    J_speed = float(0.0)
    for t in range(steps):
        p, v, q = rk4_step(p, v, q, controls[b, m, t], params.mass, params.gravity, params.dt)
        positions[b, m, t + 1] = p
        velocities[b, m, t + 1] = v
        quaternions[b, m, t + 1] = q
        write_position(i, t, p, probed)
        J_goal += goal_cost(p, v, q, p_goal, v_goal, q_goal, params)
        J_speed += speed_cost(v, params)
    for j in range(PROBES):
        write_position(i, steps + j, probe(p, p_goal, j, params), probed)
    return J_goal, J_speed


@wp.kernel
def roll_out_best(
    first: int,
    instances: int,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    velocities: wp.array3d(dtype=wp.vec3),
    quaternions: wp.array3d(dtype=wp.vec4),
    probed: wp.array4d(dtype=float),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
):
    """Stage II rollouts of the optimised controls. Launched over [instances of this chunk]."""
    i = first + wp.tid()
    b = i // instances
    m = i % instances
    goal_sum, speed_sum = roll_out(
        i, b, m, position[b], velocity[b], quaternion[b], goal_position[b], goal_velocity[b], goal_quaternion[b],
        params[b], controls, positions, velocities, quaternions, probed,
    )  # fmt: skip
    J_goal[b, m] = goal_sum
    J_speed[b, m] = speed_sum


@wp.func
def score_instance(
    i: int, b: int, m: int, safe: float, goal: wp.vec3, params: Params, distance: wp.array3d(dtype=float),
    positions: wp.array3d(dtype=wp.vec3), J_goal: wp.array2d(dtype=float), J_speed: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float), S2: wp.array2d(dtype=float), clearance: wp.array3d(dtype=float),
) -> bool:  # fmt: skip
    """Write J_col, S2 and the clearance of one instance; returns whether it is safe."""
    steps = clearance.shape[2]
    nearest = float(1.0e9)
    for t in range(steps):
        d = distance[i, t, 0]
        nearest = wp.min(nearest, d)
        clearance[b, m, t] = wp.min(d, params.distance_max)
    collision, to_go = clearance_cost(i, 0, positions[b, m, steps], goal, params, distance)
    J_col[b, m] = collision
    S2[b, m] = J_goal[b, m] + collision + to_go + J_speed[b, m]
    return nearest >= safe


@wp.kernel
def select(
    goal_position: wp.array(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    cloud_age: wp.array(dtype=float),
    list: PointList,
    distance: wp.array3d(dtype=float),
    positions: wp.array3d(dtype=wp.vec3),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    clearance: wp.array3d(dtype=float),
    best: wp.array(dtype=int),
    status: wp.array(dtype=int),
):
    """Stage II: the least S2, by `prefer_safe` among the safe instances where there are any. Launched over [B].

    An instance is safe when it stays `safe_clearance` away from every point, or, for a drone that is nearer already,
    when it does not come nearer still.
    """
    b = wp.tid()
    c = params[b]
    instances = S2.shape[1]
    here = clearance_at(position[b], c.safe_clearance, b, position[b], cell_size(c), list)
    safe = c.safe_clearance
    if here < safe:
        safe = here - 0.02
    chosen = int(0)
    chosen_safe = int(0)
    for m in range(instances):
        is_safe = int(0)
        if score_instance(
            b * instances + m,
            b,
            m,
            safe,
            goal_position[b],
            c,
            distance,
            positions,
            J_goal,
            J_speed,
            J_col,
            S2,
            clearance,
        ):
            is_safe = 1
        better = S2[b, m] < S2[b, chosen]
        if c.prefer_safe != 0 and is_safe != chosen_safe:
            better = is_safe > chosen_safe
        if m == 0 or better:
            chosen = m
            chosen_safe = is_safe
    best[b] = chosen
    status[b] = OK
    if chosen_safe == 0:
        status[b] = NO_SAFE_CANDIDATE
    if cloud_age[b] > c.cloud_age_max:
        status[b] = STALE_CLOUD


@wp.kernel
def brake_where_unsafe(
    brake_index: int,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    acceleration: wp.array(dtype=wp.vec3),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    list: PointList,
    status: wp.array(dtype=int),
    best: wp.array(dtype=int),
    braked: wp.array(dtype=int),
    anchor: wp.array2d(dtype=wp.vec3),
    coefficient: wp.array3d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    velocities: wp.array3d(dtype=wp.vec3),
    quaternions: wp.array3d(dtype=wp.vec4),
    probed: wp.array4d(dtype=float),
    distance: wp.array3d(dtype=float),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    clearance: wp.array3d(dtype=float),
):
    """Where the status is not OK, put the plain braking sequence in the place of the braking candidate, or of the best
    one where there is none, with everything that follows from it. Launched over [B]."""
    b = wp.tid()
    braked[b] = -1
    if status[b] == OK:
        return
    c = params[b]
    m = best[b]
    if brake_index >= 0:
        m = brake_index
    best[b] = m
    braked[b] = m
    instances = S2.shape[1]
    i = b * instances + m
    write_brake(b, m, position[b], velocity[b], acceleration[b], quaternion[b], c, anchor, coefficient, guide, controls)
    goal_sum, speed_sum = roll_out(
        i, b, m, position[b], velocity[b], quaternion[b], goal_position[b], goal_velocity[b], goal_quaternion[b], c,
        controls, positions, velocities, quaternions, probed,
    )  # fmt: skip
    J_goal[b, m] = goal_sum
    J_speed[b, m] = speed_sum
    size = cell_size(c)
    steps = clearance.shape[2]
    for t in range(steps + PROBES):
        limit = row_limit(t, steps, c)
        x = wp.vec3(probed[i, t, 0, 0], probed[i, t, 1, 0], probed[i, t, 2, 0])
        distance[i, t, 0] = clearance_at(x, limit, b, position[b], size, list)
    score_instance(i, b, m, 0.0, goal_position[b], c, distance, positions, J_goal, J_speed, J_col, S2, clearance)


@wp.kernel
def remember(
    time: wp.array(dtype=wp.float64),
    params: wp.array(dtype=Params),
    best: wp.array(dtype=int),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    tick: wp.array(dtype=int),
    previous_controls: wp.array2d(dtype=wp.vec4),
    previous_end: wp.array(dtype=wp.vec3),
    previous_time: wp.array(dtype=wp.float64),
):
    """Keep what the next plan starts from: the controls to fly, the end they lead to, and the time. Launched over
    [B]."""
    b = wp.tid()
    m = best[b]
    steps = previous_controls.shape[1]
    for t in range(steps):
        previous_controls[b, t] = controls[b, m, t]
    previous_end[b] = positions[b, m, steps]
    tick[b] = tick[b] + 1
    if not wp.isnan(time[b]):
        previous_time[b] = time[b]
    else:
        before = previous_time[b]
        if wp.isnan(before):
            before = wp.float64(0.0)
        previous_time[b] = before + wp.float64(params[b].replan_period)
