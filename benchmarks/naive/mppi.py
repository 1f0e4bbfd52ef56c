"""Stage I: noise, rollouts, clearance, softmin, update.

Instance i = b M + m is instance m of drone b.
"""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.mppi import NOISE_STEP
from aero_planner.kernels.params import Params
from benchmarks.naive.model import (
    PROBES,
    blocked_cost,
    clamp_control,
    collision_cost,
    goal_cost,
    probe_position,
    rk4,
    speed_cost,
)

__all__ = [
    "clearance",
    "collision_and_blocked",
    "distance_to",
    "draw_noise",
    "rollouts",
    "scores",
    "softmin",
    "update",
]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def draw_noise(
    instances: int,
    seed: wp.array(dtype=int),
    tick: wp.array(dtype=int),
    params: wp.array(dtype=Params),
    table: wp.array3d(dtype=float),
    noise: wp.array3d(dtype=wp.vec4),
):
    """Write white noise of unit variance, shape [B M, K, N]. Launched over [B M, K].

    It is the noise that `aero_planner.kernels.mppi` draws from its table [N, 4, rows]: consecutive rows from a random
    multiple of NOISE_STEP on, with random signs.
    """
    i, k = wp.tid()
    b = i // instances
    draw = tick[b] * params[b].fresh_noise
    bits = int(wp.rand_init(seed[b] + 7919 * draw, i % instances) & wp.uint32(0x7FFFFFFF))
    rows = table.shape[2]
    row = (bits % (rows // NOISE_STEP) * NOISE_STEP + k) % rows
    for t in range(noise.shape[2]):
        e = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for j in range(4):
            e[j] = table[t, j, row] * float(1 - 2 * ((bits >> (16 + j)) & 1))
        noise[i, k, t] = e


@wp.kernel
def rollouts(
    instances: int,
    previous_index: int,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    guide: wp.array3d(dtype=wp.vec3),
    waypoint: wp.array2d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
    noise: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    cost: wp.array2d(dtype=float),
):
    """Write noisy controls, their states, and J_track + J_vnorm + J_ctrl + J_goal + the speed cost.

    Shapes [B M, K, N], positions [B M, K, N + PROBES]. Launched over [B M, K].
    """
    i, k = wp.tid()
    b = i // instances
    m = i % instances
    c = params[b]
    N = controls.shape[2]
    deviation = wp.vec4(
        wp.sqrt(c.variance_thrust), wp.sqrt(c.variance_rate_xy), wp.sqrt(c.variance_rate_xy), wp.sqrt(c.variance_rate_z)
    )
    if k == 0 and c.keep_nominal != 0:
        deviation = wp.vec4(0.0, 0.0, 0.0, 0.0)
    p = position[b]
    v = velocity[b]
    q = quaternion[b]
    e = noise[i, k, 0]
    before = wp.vec4(0.0, 0.0, 0.0, 0.0)
    S = float(0.0)
    for t in range(N):
        if t > 0:
            e = c.correlation * e + wp.sqrt(1.0 - c.correlation * c.correlation) * noise[i, k, t]
        u = clamp_control(nominal[b, m, t] + wp.cw_mul(deviation, e), c)
        controls[i, k, t] = u
        if t < N - 1:
            S += c.q_control * wp.dot(u, u)
        if t > 0 and t < N - 1:
            S += c.q_control_rate * wp.dot(u - before, u - before)
        before = u
        p, v, q = rk4(p, v, q, u, c)
        positions[i, k, t] = p
        if m != previous_index:
            S += c.q_track * wp.length(p - guide[b, m, t + 1])
        S += c.q_vnorm * wp.dot(v, v)
        S += goal_cost(p, v, q, goal_position[b], goal_velocity[b], goal_quaternion[b], c)
        S += speed_cost(v, c)
    for j in range(PROBES):
        positions[i, k, N + j] = probe_position(p, waypoint[b, m], goal_position[b], j, c)
    cost[i, k] = S


@wp.func
def distance_to(
    x: wp.vec3, limit: float, b: int, ground: float, c: Params, count: wp.array(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
) -> float:  # fmt: skip
    """Return the distance from x to the nearest point of the filtered cloud or to the ground, at most `limit` [m]."""
    best = limit * limit
    for j in range(count[b]):
        d = filtered[b, j] - x
        best = wp.min(best, wp.dot(d, d))
    nearest = wp.sqrt(best)
    if c.use_ground == 0:
        return nearest
    return wp.min(nearest, wp.max(0.0, x[2] - ground))


@wp.kernel
def clearance(
    instances: int,
    steps: int,
    ground_height: wp.array(dtype=float),
    params: wp.array(dtype=Params),
    count: wp.array(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
):
    """Find the clearance of every position by a search over all points. Launched over [B M, K, rows].

    Rows are the states, the probes and, if there are such rows, the midpoints between states.
    """
    i, k, t = wp.tid()
    b = i // instances
    c = params[b]
    limit = wp.max(c.distance_max, c.safe_clearance)
    if t >= steps + PROBES:
        limit = c.safe_clearance
    elif t >= steps:
        limit = c.blocked_radius
    distance[i, k, t] = distance_to(positions[i, k, t], limit, b, ground_height[b], c, count, filtered)


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
def scores(
    instances: int,
    goal_position: wp.array(dtype=wp.vec3),
    waypoint: wp.array2d(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    cost: wp.array2d(dtype=float),
):
    """S1 of every sample. Launched over [B M, K]."""
    i, k = wp.tid()
    b = i // instances
    steps = distance.shape[2] - PROBES
    waypoint_m = waypoint[b, i % instances]
    J_col, to_go = collision_and_blocked(i, k, steps, waypoint_m, goal_position[b], params[b], positions, distance)
    cost[i, k] = cost[i, k] + J_col + to_go


@wp.kernel
def softmin(
    instances: int, params: wp.array(dtype=Params), cost: wp.array2d(dtype=float), weight: wp.array2d(dtype=float)
):
    """w_k = exp(-(S_k - min S) / lambda) / sum. Launched over [B M]."""
    i = wp.tid()
    K = cost.shape[1]
    least = cost[i, 0]
    for k in range(1, K):
        least = wp.min(least, cost[i, k])
    total = float(0.0)
    for k in range(K):
        weight[i, k] = wp.exp(-(cost[i, k] - least) / params[i // instances].temperature)
        total += weight[i, k]
    for k in range(K):
        weight[i, k] = weight[i, k] / total


@wp.kernel
def update(
    instances: int,
    nominal: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
    weight: wp.array2d(dtype=float),
    optimised: wp.array3d(dtype=wp.vec4),
):
    """Nominal + sum_k w_k (u_k - nominal). Launched over [B M, N]."""
    i, t = wp.tid()
    u = nominal[i // instances, i % instances, t]
    change = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(weight.shape[1]):
        change += weight[i, k] * (controls[i, k, t] - u)
    optimised[i // instances, i % instances, t] = u + change
