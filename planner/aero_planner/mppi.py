"""Model predictive path integral control, Stage I: sampling, rollouts, weights, update.

Instance i = b M + m is instance m of drone b. Rows t of sampled arrays lie before samples k, so that threads of
neighbouring samples touch neighbouring memory.
"""

from __future__ import annotations

import warp as wp

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
from aero_planner.params import Params

__all__ = ["PROBES", "clearance_cost", "probe", "sample_rollouts", "score_samples", "update", "weigh"]

wp.set_module_options({"enable_backward": False})

PROBES = wp.constant(10)
"""Positions on the line from the last state toward the goal, at which the cost-to-go looks for obstacles."""


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

    `controls` and `positions` have shapes [B M, N, K] and [B M, N + PROBES, K]. Launched over [instances of this lane,
    K].
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
    """Nominal + sum_k w_k (u_k - nominal): the noise as it acted, after the clamp. Launched over [instances of this
    lane, N]."""
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
