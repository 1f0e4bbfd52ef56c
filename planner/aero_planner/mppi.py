"""Model predictive path integral control, Stage I: sampling, rollouts, weights, update.

Instance i = b M + m is instance m of drone b. Samples k are the last axis of sampled arrays, so that neighbouring samples
touch neighbouring memory, be it in the threads of a GPU or in the vectors of a CPU.
"""

from __future__ import annotations

import functools
from typing import Any

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

NOISE_STEP = wp.constant(64)
"""The random sequence to begin with is a multiple of this, for which `width` divides it."""

PROBES = wp.constant(10)
"""Positions on the line from the last state toward the goal, at which the cost-to-go looks for obstacles."""


@wp.kernel
def fill_noise(noise: wp.array3d(dtype=float)):
    """White noise of unit variance, shape [N, 4, NOISE_ROWS]. Launched over [N, NOISE_ROWS]."""
    t, row = wp.tid()
    random = wp.rand_init(20509, t * noise.shape[2] + row)
    for i in range(4):
        noise[t, i, row] = wp.randn(random)


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


@functools.cache
def sample_rollouts(width: int) -> wp.Kernel:
    """Return the kernel that rolls out `width` samples in each thread: on a CPU, many with the same instructions."""
    WIDTH = wp.constant(width)
    Reals: Any = wp.types.vector(length=width, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
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
        noise_table: wp.array3d(dtype=Reals),
        guide: wp.array3d(dtype=wp.vec3),
        nominal: wp.array3d(dtype=wp.vec4),
        controls: wp.array4d(dtype=Reals),
        positions: wp.array4d(dtype=Reals),
        cost: wp.array2d(dtype=Reals),
    ):
        """Stage I rollouts of noisy, clamped controls, and S1 without the terms that need the clearance.

        `controls` and `positions` have shapes [B M, N, 4, K] and [B M, N + PROBES, 3, K], in vectors of `width`
        samples, as has `noise_table`, [N, 4, NOISE_ROWS]. Launched over [instances of this chunk, K / width].
        """
        offset, group = wp.tid()
        i = first + offset
        b = i // instances
        m = i % instances
        c = params[b]
        steps = controls.shape[1]
        draw = int(0)
        if c.fresh_noise != 0:
            draw = tick[b]
        bits = int(wp.rand_init(seed[b] + 7919 * draw, m) & wp.uint32(0x7FFFFFFF))
        row = (bits % (NOISE_ROWS // NOISE_STEP) * (NOISE_STEP // WIDTH) + group) % (NOISE_ROWS // WIDTH)
        sigma = wp.vec4(
            random_sign(bits, 16) * wp.sqrt(c.variance_thrust),
            random_sign(bits, 17) * wp.sqrt(c.variance_rate_xy),
            random_sign(bits, 18) * wp.sqrt(c.variance_rate_xy),
            random_sign(bits, 19) * wp.sqrt(c.variance_rate_z),
        )
        track = float(1.0)
        if m == previous_index:
            track = float(0.0)
        p_goal = goal_position[b]
        v_goal = goal_velocity[b]
        q_goal = goal_quaternion[b]
        x0 = position[b]
        v0 = velocity[b]
        q0 = quaternion[b]
        px = Reals(x0[0])
        py = Reals(x0[1])
        pz = Reals(x0[2])
        vx = Reals(v0[0])
        vy = Reals(v0[1])
        vz = Reals(v0[2])
        qw = Reals(q0[0])
        qx = Reals(q0[1])
        qy = Reals(q0[2])
        qz = Reals(q0[3])
        n0 = Reals()
        n1 = Reals()
        n2 = Reals()
        n3 = Reals()
        u0 = Reals()
        u1 = Reals()
        u2 = Reals()
        u3 = Reals()
        S = Reals()
        noisy = Reals(1.0)
        if group == 0 and c.keep_nominal != 0:
            noisy[0] = 0.0
        fresh = float(1.0)
        for t in range(steps):
            u_nominal = nominal[b, m, t]
            p_guide = guide[b, m, t + 1]
            e0 = noise_table[t, 0, row]
            e1 = noise_table[t, 1, row]
            e2 = noise_table[t, 2, row]
            e3 = noise_table[t, 3, row]
            # J_ctrl leaves out the last control, and the change to the first.
            counted = wp.where(t < steps - 1, 1.0, 0.0)
            change_counted = wp.where(t > 0, counted, 0.0)
            for j in range(WIDTH):
                # AR(1) with the variance of its innovations scaled to keep the noise's own.
                noise = c.correlation * wp.vec4(n0[j], n1[j], n2[j], n3[j]) + fresh * wp.vec4(e0[j], e1[j], e2[j], e3[j])
                u = clamp_control(u_nominal + noisy[j] * wp.cw_mul(sigma, noise), c)
                u_before = wp.vec4(u0[j], u1[j], u2[j], u3[j])
                p = wp.vec3(px[j], py[j], pz[j])
                v = wp.vec3(vx[j], vy[j], vz[j])
                q = wp.vec4(qw[j], qx[j], qy[j], qz[j])
                p, v, q = rk4_step(p, v, q, u, c.mass, c.gravity, c.dt)
                S[j] = (
                    S[j]
                    + counted * control_cost(u, c)
                    + change_counted * control_rate_cost(u, u_before, c)
                    + track * track_cost(p, p_guide, c)
                    + vnorm_cost(v, c)
                    + goal_cost(p, v, q, p_goal, v_goal, q_goal, c)
                    + speed_cost(v, c)
                )
                n0[j] = noise[0]
                n1[j] = noise[1]
                n2[j] = noise[2]
                n3[j] = noise[3]
                u0[j] = u[0]
                u1[j] = u[1]
                u2[j] = u[2]
                u3[j] = u[3]
                px[j] = p[0]
                py[j] = p[1]
                pz[j] = p[2]
                vx[j] = v[0]
                vy[j] = v[1]
                vz[j] = v[2]
                qw[j] = q[0]
                qx[j] = q[1]
                qy[j] = q[2]
                qz[j] = q[3]
            fresh = wp.sqrt(1.0 - c.correlation * c.correlation)
            controls[i, t, 0, group] = u0
            controls[i, t, 1, group] = u1
            controls[i, t, 2, group] = u2
            controls[i, t, 3, group] = u3
            positions[i, t, 0, group] = px
            positions[i, t, 1, group] = py
            positions[i, t, 2, group] = pz
        cost[i, group] = S
        if c.q_blocked > 0.0:
            for ahead in range(PROBES):
                for j in range(WIDTH):
                    place = probe(wp.vec3(px[j], py[j], pz[j]), p_goal, ahead, c)
                    u0[j] = place[0]
                    u1[j] = place[1]
                    u2[j] = place[2]
                positions[i, steps + ahead, 0, group] = u0
                positions[i, steps + ahead, 1, group] = u1
                positions[i, steps + ahead, 2, group] = u2

    return sample_rollouts


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
    positions: wp.array4d(dtype=float),
    distance: wp.array3d(dtype=float),
    cost: wp.array2d(dtype=float),
):
    """Complete S1 by the terms that need the clearance. Launched over [instances of this chunk, K]."""
    offset, k = wp.tid()
    i = first + offset
    b = i // instances
    t = distance.shape[1] - PROBES - 1
    last = wp.vec3(positions[i, t, 0, k], positions[i, t, 1, k], positions[i, t, 2, k])
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
    for k in range(1, weight.shape[1]):
        least = wp.min(least, cost[i, k])
    total = float(0.0)
    for k in range(weight.shape[1]):
        w = wp.exp((least - cost[i, k]) / temperature)
        weight[i, k] = w
        total += w
    for k in range(weight.shape[1]):
        weight[i, k] = weight[i, k] / total


@wp.kernel
def update(
    first: int,
    instances: int,
    nominal: wp.array3d(dtype=wp.vec4),
    controls: wp.array4d(dtype=float),
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
            sample = wp.vec4(controls[i, t, 0, k], controls[i, t, 1, k], controls[i, t, 2, k], controls[i, t, 3, k])
            du += w * (sample - u)
    optimised[b, m, t] = u + du
