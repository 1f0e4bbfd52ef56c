"""Stage I: noise, rollouts, clearance, softmin, update."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.mppi import NOISE_STEP
from aero_planner.device.params import Params
from benchmarks.naive.arrays import Arrays
from benchmarks.naive.model import (
    PROBES,
    blocked_cost,
    clamp_control,
    collision_cost,
    follow_command,
    goal_cost,
    jump_cost,
    probe_position,
    rk4,
    speed_cost,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def draw_noise(seed: wp.array(dtype=int), table: wp.array3d(dtype=float), a: Arrays):
    """Write white noise of unit variance. Launched over [B M, K].

    It is the noise that `aero_planner.kernels.mppi` draws from its table [N, 4, rows]: consecutive rows from a random
    multiple of NOISE_STEP on, with random signs.
    """
    i, k = wp.tid()
    M = a.nominal.shape[1]
    b = i // M
    draw = a.tick[b] * a.params[b].fresh_noise
    bits = int(wp.rand_init(seed[b] + 7919 * draw, i % M) & wp.uint32(0x7FFFFFFF))
    rows = table.shape[2]
    row = (bits % (rows // NOISE_STEP) * NOISE_STEP + k) % rows
    for t in range(a.noise.shape[2]):
        e = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for j in range(4):
            e[j] = table[t, j, row] * float(1 - 2 * ((bits >> (16 + j)) & 1))
        a.noise[i, k, t] = e


@wp.kernel
def rollouts(a: Arrays):
    """Write noisy controls, their states, and J_track + J_vnorm + J_ctrl + J_goal + the speed cost.

    Launched over [B M, K].
    """
    i, k = wp.tid()
    b = i // a.nominal.shape[1]
    m = i % a.nominal.shape[1]
    c = a.params[b]
    N = a.nominal.shape[2]
    deviation = wp.vec4(
        wp.sqrt(c.variance_thrust), wp.sqrt(c.variance_rate_xy), wp.sqrt(c.variance_rate_xy), wp.sqrt(c.variance_rate_z)
    )
    if k == 0 and c.keep_nominal != 0:
        deviation = wp.vec4(0.0, 0.0, 0.0, 0.0)
    p = a.position[b]
    v = a.velocity[b]
    q = a.q0[b]
    control = a.control[b]
    e = a.noise[i, k, 0]
    before = a.command[b]
    S = float(0.0)
    for t in range(N):
        if t > 0:
            e = c.correlation * e + wp.sqrt(1.0 - c.correlation * c.correlation) * a.noise[i, k, t]
        u = clamp_control(a.nominal[b, m, t] + wp.cw_mul(deviation, e), c)
        a.sample_controls[i, k, t] = u
        if t < N - 1:
            S += c.q_control * wp.dot(u, u)
        if t > 0 and t < N - 1:
            S += c.q_control_rate * wp.dot(u - before, u - before)
        if t == 0:
            S += jump_cost(u, before, c)
        before = u
        mean, control = follow_command(control, u, c.dt, c)
        p, v, q = rk4(p, v, q, mean, c)
        a.sample_positions[i, k, t] = p
        if m != a.previous_index:
            S += c.q_track * wp.length(p - a.guide[b, m, t + 1])
        S += c.q_vnorm * wp.dot(v, v)
        S += goal_cost(p, v, q, a.goal_position[b], a.v_goal[b], a.q_goal[b], c)
        S += speed_cost(v, c)
    for j in range(PROBES):
        a.sample_positions[i, k, N + j] = probe_position(p, a.waypoint[b, m], a.goal_position[b], j, c)
    a.cost[i, k] = S


@wp.func
def distance_to(x: wp.vec3, limit: float, b: int, a: Arrays) -> float:
    """Return the distance from x to the nearest point of the filtered cloud or to the ground, at most `limit` [m]."""
    best = limit * limit
    for j in range(a.count[b]):
        d = a.filtered[b, j] - x
        best = wp.min(best, wp.dot(d, d))
    nearest = wp.sqrt(best)
    if a.params[b].use_ground == 0:
        return nearest
    return wp.min(nearest, wp.max(0.0, x[2] - a.ground_height[b]))


@wp.kernel
def clearance(instances: int, a: Arrays, positions: wp.array3d(dtype=wp.vec3), distance: wp.array3d(dtype=float)):
    """Find the clearance of every position by a search over all points. Launched over the shape of `distance`.

    Rows are the states, the probes and, if there are such rows, the midpoints between states.
    """
    i, k, t = wp.tid()
    b = i // instances
    c = a.params[b]
    N = a.nominal.shape[2]
    limit = wp.max(c.distance_max, c.safe_clearance)
    if t >= N + PROBES:
        limit = c.safe_clearance
    elif t >= N:
        limit = c.blocked_radius
    distance[i, k, t] = distance_to(positions[i, k, t], limit, b, a)


@wp.func
def collision_and_blocked(i: int, k: int, steps: int, waypoint: wp.vec3, goal: wp.vec3, c: Params,
                          positions: wp.array3d(dtype=wp.vec3), distance: wp.array3d(dtype=float)):  # fmt: skip
    """Return J_col of one rollout, and its cost-to-go."""
    J_col = float(0.0)
    for t in range(steps):
        J_col += collision_cost(distance[i, k, t], c)
    blocked = int(0)
    for j in range(PROBES):
        if distance[i, k, steps + j] < c.blocked_radius:
            blocked += 1
    return J_col, blocked_cost(positions[i, k, steps - 1], waypoint, goal, blocked, c)


@wp.kernel
def scores(a: Arrays):
    """Add J_col and the cost-to-go to S1 of every sample. Launched over [B M, K]."""
    i, k = wp.tid()
    b = i // a.nominal.shape[1]
    m = i % a.nominal.shape[1]
    J_col, to_go = collision_and_blocked(
        i, k, a.nominal.shape[2], a.waypoint[b, m], a.goal_position[b], a.params[b], a.sample_positions,
        a.sample_distance,
    )  # fmt: skip
    a.cost[i, k] = a.cost[i, k] + J_col + to_go


@wp.kernel
def softmin(a: Arrays):
    """w_k = exp(-(S_k - min S) / lambda) / sum. Launched over [B M]."""
    i = wp.tid()
    K = a.cost.shape[1]
    least = a.cost[i, 0]
    for k in range(1, K):
        least = wp.min(least, a.cost[i, k])
    total = float(0.0)
    for k in range(K):
        a.weight[i, k] = wp.exp(-(a.cost[i, k] - least) / a.params[i // a.nominal.shape[1]].temperature)
        total += a.weight[i, k]
    for k in range(K):
        a.weight[i, k] = a.weight[i, k] / total


@wp.kernel
def update(a: Arrays):
    """Nominal + sum_k w_k (u_k - nominal). Launched over [B M, N]."""
    i, t = wp.tid()
    b = i // a.nominal.shape[1]
    m = i % a.nominal.shape[1]
    u = a.nominal[b, m, t]
    change = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(a.weight.shape[1]):
        change += a.weight[i, k] * (a.sample_controls[i, k, t] - u)
    a.controls[b, m, t] = u + change
