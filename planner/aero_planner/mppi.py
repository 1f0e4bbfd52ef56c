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

__all__ = [
    "NOISE_ROWS",
    "PROBES",
    "clearance_cost",
    "fill_noise",
    "probe",
    "sample_rollouts",
    "score_samples",
    "update",
    "weigh",
]

wp.set_module_options({"enable_backward": False})

NOISE_ROWS = wp.constant(16384)
"""Sequences of noise that are drawn once. Drawing afresh would take most of a rollout's time on a CPU; instead the
samples of an instance take successive sequences from a random one on, with random signs, so that they stay independent
of each other, and equal noise meets again at random after thousands of plans only."""

PROBES = wp.constant(10)
"""Positions on the line from the last state toward the goal, at which the cost-to-go looks for obstacles."""


@wp.kernel
def fill_noise(noise: wp.array2d(dtype=wp.vec4)):
    """White noise of unit variance, shape [N, NOISE_ROWS]. Launched over its shape."""
    t, row = wp.tid()
    random = wp.rand_init(20509, t * noise.shape[1] + row)
    noise[t, row] = wp.vec4(wp.randn(random), wp.randn(random), wp.randn(random), wp.randn(random))


@wp.func
def random_sign(bits: int, i: int) -> float:
    """-1 or 1 by the i-th bit."""
    return float(1 - 2 * ((bits >> i) & 1))


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
    noise_table: wp.array2d(dtype=wp.vec4),
    guide: wp.array3d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    cost: wp.array2d(dtype=float),
):
    """Stage I rollouts of noisy, clamped controls, and S1 without the terms that need the clearance.

    `controls` and `positions` have shapes [B M, N, K] and [B M, N + PROBES, K]. Launched over [instances of this chunk,
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
    bits = int(wp.rand_init(seed[b] + 7919 * draw, m) & wp.uint32(0x7FFFFFFF))
    row = (bits % NOISE_ROWS + k) % NOISE_ROWS  # bits + k may exceed an int
    sigma = wp.vec4(
        random_sign(bits, 16) * wp.sqrt(c.variance_thrust),
        random_sign(bits, 17) * wp.sqrt(c.variance_rate_xy),
        random_sign(bits, 18) * wp.sqrt(c.variance_rate_xy),
        random_sign(bits, 19) * wp.sqrt(c.variance_rate_z),
    )
    if k == 0 and c.keep_nominal != 0:
        sigma = wp.vec4(0.0, 0.0, 0.0, 0.0)
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
        noise = c.correlation * noise + fresh * noise_table[t, row]
        fresh = wp.sqrt(1.0 - c.correlation * c.correlation)
        u = clamp_control(nominal[b, m, t] + wp.cw_mul(sigma, noise), c)
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
    """Complete S1 by the terms that need the clearance. Launched over [instances of this chunk, K]."""
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
    """w_k = exp(-(S_k - min S) / lambda) / sum. Launched over [instances of this chunk]."""
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
