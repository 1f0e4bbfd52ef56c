"""Model predictive path integral control: sampling, rollouts, weights, update, and stage II.

Instance i = b M + m is instance m of drone b. Rows t of sampled arrays lie before samples k, so that threads of
neighbouring samples touch neighbouring memory.
"""

from __future__ import annotations

import warp as wp

from aero_planner.clearance import cell_size, clearance_at
from aero_planner.costs import (
    collision_cost,
    control_cost,
    control_rate_cost,
    goal_cost,
    speed_cost,
    track_cost,
    vnorm_cost,
)
from aero_planner.dynamics import clamp_control, rk4_step
from aero_planner.guides import write_brake
from aero_planner.params import Params

__all__ = [
    "PROBES",
    "brake_where_unsafe",
    "remember",
    "roll_out_best",
    "sample_rollouts",
    "score_samples",
    "select",
    "update",
    "weigh",
]

wp.set_module_options({"enable_backward": False})

PROBES = wp.constant(10)
"""Positions on the line from the last state toward the goal, at which the cost-to-go looks for obstacles."""

OK = wp.constant(0)
NO_SAFE_CANDIDATE = wp.constant(1)
STALE_CLOUD = wp.constant(2)


@wp.func
def probe(p: wp.vec3, goal: wp.vec3, j: int, params: Params) -> wp.vec3:
    """The j-th position on the line from p toward the goal, at the middle of its piece of the line."""
    to_goal = goal - p
    distance = wp.length(to_goal)
    length = wp.min(params.blocked_range, distance)
    return p + ((float(j) + 0.5) / float(PROBES) * length / wp.max(distance, 1.0e-6)) * to_goal


@wp.func
def blocked_cost(p: wp.vec3, goal: wp.vec3, blocked: int, params: Params) -> float:
    """Option beside the paper: q_blocked times the blocked metres of the line from the last state p toward the goal."""
    length = wp.min(params.blocked_range, wp.length(goal - p))
    return params.q_blocked * length * float(blocked) / float(PROBES)


@wp.kernel
def sample_rollouts(
    first: int,
    instances: int,
    previous_index: int,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    seed: wp.array(dtype=int),
    tick: wp.array(dtype=int),
    guide: wp.array3d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    cost: wp.array2d(dtype=float),
):
    """Stage I rollouts of noisy, clamped controls, and S1 without the terms that need the clearance.

    `controls` and `positions` have shapes [B M, N, K] and [B M, N + PROBES, K]. Launched over [instances of this lane, K].
    """
    offset, k = wp.tid()
    i = first + offset
    b = i // instances
    m = i % instances
    c = params[b]
    steps = controls.shape[1]
    draw = int(0)
    if c.fresh_noise != 0:
        draw = tick[b]
    random = wp.rand_init(seed[b] + 7919 * draw, m * cost.shape[1] + k)
    sigma_thrust = wp.sqrt(c.variance_thrust)
    sigma_xy = wp.sqrt(c.variance_rate_xy)
    sigma_z = wp.sqrt(c.variance_rate_z)
    if k == 0 and c.keep_nominal != 0:
        sigma_thrust = float(0.0)
        sigma_xy = float(0.0)
        sigma_z = float(0.0)
    track = float(1.0)
    if m == previous_index:
        track = float(0.0)
    p = position[b]
    v = velocity[b]
    q = quaternion[b]
    p_goal = goal_position[b]
    v_goal = goal_velocity[b]
    q_goal = goal_quaternion[b]
    noise = wp.vec4(0.0, 0.0, 0.0, 0.0)
    fresh = float(1.0)
    u_before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    S = float(0.0)
    for t in range(steps):
        # AR(1) with the variance of its innovations scaled to keep the noise's own.
        white = wp.vec4(wp.randn(random), wp.randn(random), wp.randn(random), wp.randn(random))
        noise = c.correlation * noise + fresh * white
        fresh = wp.sqrt(1.0 - c.correlation * c.correlation)
        u = nominal[b, m, t] + wp.vec4(
            sigma_thrust * noise[0], sigma_xy * noise[1], sigma_xy * noise[2], sigma_z * noise[3]
        )
        u = clamp_control(u, c)
        controls[i, t, k] = u
        if t < steps - 1:
            S += control_cost(u, c)
            if t > 0:
                S += control_rate_cost(u, u_before, c)
        u_before = u
        p, v, q = rk4_step(p, v, q, u, c.mass, c.gravity, c.dt)
        positions[i, t, k] = p
        S += track * track_cost(p, guide[b, m, t + 1], c) + vnorm_cost(v, c)
        S += goal_cost(p, v, q, p_goal, v_goal, q_goal, c) + speed_cost(v, c)
    if c.q_blocked > 0.0:
        for j in range(PROBES):
            positions[i, steps + j, k] = probe(p, p_goal, j, c)
    cost[i, k] = S


@wp.func
def clearance_cost(
    i: int, k: int, p_last: wp.vec3, goal: wp.vec3, params: Params, distance: wp.array3d(dtype=float)
):  # fmt: skip
    """J_col of a rollout, and its cost-to-go."""
    steps = distance.shape[1] - PROBES
    J_col = float(0.0)
    for t in range(steps):
        J_col += collision_cost(distance[i, t, k], params)
    to_go = float(0.0)
    if params.q_blocked > 0.0:
        blocked = int(0)
        for j in range(PROBES):
            if distance[i, steps + j, k] < params.blocked_radius:
                blocked += 1
        to_go = blocked_cost(p_last, goal, blocked, params)
    return J_col, to_go


@wp.kernel
def score_samples(
    first: int,
    instances: int,
    goal_position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    cost: wp.array2d(dtype=float),
):
    """Complete S1 by the terms that need the clearance. Launched over [instances of this lane, K]."""
    offset, k = wp.tid()
    i = first + offset
    b = i // instances
    last = positions[i, distance.shape[1] - PROBES - 1, k]
    J_col, to_go = clearance_cost(i, k, last, goal_position[b], params[b], distance)
    cost[i, k] = cost[i, k] + J_col + to_go


@wp.kernel
def weigh(
    first: int,
    instances: int,
    params: wp.array(dtype=Params),
    cost: wp.array2d(dtype=float),
    weight: wp.array2d(dtype=float),
):
    """w_k = exp(-(S_k - min S) / lambda) / sum. Launched over [instances of this lane]."""
    i = first + wp.tid()
    temperature = params[i // instances].temperature
    least = cost[i, 0]
    for k in range(1, cost.shape[1]):
        least = wp.min(least, cost[i, k])
    total = float(0.0)
    for k in range(cost.shape[1]):
        w = wp.exp((least - cost[i, k]) / temperature)
        weight[i, k] = w
        total += w
    for k in range(cost.shape[1]):
        weight[i, k] = weight[i, k] / total


@wp.kernel
def update(
    first: int,
    instances: int,
    nominal: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
    weight: wp.array2d(dtype=float),
    optimised: wp.array3d(dtype=wp.vec4),
):
    """Nominal + sum_k w_k (u_k - nominal): the noise as it acted, after the clamp. Launched over [instances of this lane, N]."""
    offset, t = wp.tid()
    i = first + offset
    b = i // instances
    m = i % instances
    u = nominal[b, m, t]
    du = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(weight.shape[1]):
        w = weight[i, k]
        if w > 0.0:
            du += w * (controls[i, t, k] - u)
    optimised[b, m, t] = u + du


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
    probed: wp.array3d(dtype=wp.vec3),
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
        probed[i, t, 0] = p
        J_goal += goal_cost(p, v, q, p_goal, v_goal, q_goal, params)
        J_speed += speed_cost(v, params)
    for j in range(PROBES):
        probed[i, steps + j, 0] = probe(p, p_goal, j, params)
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
    probed: wp.array3d(dtype=wp.vec3),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
):
    """Stage II rollouts of the optimised controls. Launched over [instances of this lane]."""
    i = first + wp.tid()
    b = i // instances
    m = i % instances
    goal_sum, speed_sum = roll_out(
        i, b, m, position[b], velocity[b], quaternion[b], goal_position[b], goal_velocity[b], goal_quaternion[b], params[b],
        controls, positions, velocities, quaternions, probed,
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
    near: wp.array2d(dtype=wp.uint8),
    start: wp.array2d(dtype=int),
    end: wp.array2d(dtype=int),
    sorted_points: wp.array2d(dtype=wp.vec3),
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
    """Stage II: the least S2 among the safe instances; among all of them when none is safe. Launched over [B].

    An instance is safe when it stays `safe_clearance` away from every point, or, for a drone that is nearer already, when it
    does not come nearer still.
    """
    b = wp.tid()
    c = params[b]
    instances = S2.shape[1]
    here = clearance_at(
        position[b], c.safe_clearance, b, position[b], cell_size(c), near, start, end, sorted_points
    )
    safe = wp.min(c.safe_clearance, here - 0.02)
    chosen = int(0)
    chosen_safe = int(0)
    for m in range(instances):
        is_safe = int(0)
        if score_instance(
            b * instances + m, b, m, safe, goal_position[b], c, distance, positions, J_goal, J_speed, J_col, S2, clearance
        ):
            is_safe = 1
        if is_safe > chosen_safe or (is_safe == chosen_safe and S2[b, m] < S2[b, chosen]):
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
    near: wp.array2d(dtype=wp.uint8),
    start: wp.array2d(dtype=int),
    end: wp.array2d(dtype=int),
    sorted_points: wp.array2d(dtype=wp.vec3),
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
    probed: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    clearance: wp.array3d(dtype=float),
):
    """Where the status is not OK, put the plain braking sequence in the place of the braking candidate, or of the best one
    where there is none, with everything that follows from it. Launched over [B]."""
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
    limit = wp.max(c.distance_max, c.safe_clearance)
    steps = clearance.shape[2]
    for t in range(steps + PROBES):
        if t == steps:
            limit = c.blocked_radius
        distance[i, t, 0] = clearance_at(
            probed[i, t, 0], limit, b, position[b], size, near, start, end, sorted_points
        )
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
    """Keep what the next plan starts from: the controls to fly, the end they lead to, and the time. Launched over [B]."""
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
