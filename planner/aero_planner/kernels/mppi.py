"""Model predictive path integral control, Stage I: sampling, rollouts, weights, update.

Instance i = b M + m is instance m of drone b. Samples k are the last axis of sampled arrays, so that neighbouring
samples touch neighbouring memory, be it in the threads of a GPU or in the vectors of a CPU.
"""

# No postponed annotations: those of kernels that `width` shapes name local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.costs import (
    control_cost,
    control_rate_cost,
    goal_cost,
    speed_cost,
    track_cost,
    vnorm_cost,
)
from aero_planner.kernels.dynamics import clamp_control, rk4_step
from aero_planner.kernels.kernel_tuning import Widths, least_of, read_group, sum_of, wait_for_block
from aero_planner.kernels.params import Params

__all__ = [
    "NOISE_ROWS",
    "PROBES",
    "blocked_cost",
    "fill_noise",
    "improve",
    "probe",
    "sample_rollouts",
]

wp.set_module_options({"enable_backward": False})

NOISE_ROWS = wp.constant(16384)
"""Sequences of noise that are drawn once. Drawing afresh would take most of a rollout's time on a CPU; instead the
samples of an instance take successive sequences from a random one on, with random signs, so that they stay independent
of each other, and equal noise meets again at random after thousands of plans only."""

NOISE_STEP = wp.constant(64)
"""The random sequence to begin with is a multiple of this, for which `width` divides it."""

AT_ONCE = wp.constant(5)
"""Costs, and values of controls, that are read at a time, so that a GPU waits for memory less often."""

Some: Any = wp.types.vector(length=5, dtype=wp.float32)

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
def probe(p: wp.vec3, turn: wp.vec3, goal: wp.vec3, j: int, params: Params) -> wp.vec3:
    """The j-th position on the way from p to the goal by a turning point, at the middle of its piece of the way."""
    to_turn = turn - p
    onward = goal - turn
    first = wp.length(to_turn)
    second = wp.length(onward)
    s = (float(j) + 0.5) / float(PROBES) * wp.min(params.blocked_range, first + second)
    before = p + (s / wp.max(first, 1.0e-6)) * to_turn
    after = turn + ((s - first) / wp.max(second, 1.0e-6)) * onward
    return wp.where(s <= first, before, after)


@wp.func
def blocked_cost(p: wp.vec3, turn: wp.vec3, goal: wp.vec3, blocked: int, params: Params) -> float:
    """Option beside the paper: q_blocked times the blocked metres of the way from the last state p to the goal."""
    length = wp.min(params.blocked_range, wp.length(turn - p) + wp.length(goal - turn))
    return params.q_blocked * length * float(blocked) / float(PROBES)


@functools.cache
def sample_rollouts(of: Widths) -> wp.Kernel:
    """Return the kernel that rolls out `of.samples` samples in each thread: on a CPU, many with the same
    instructions."""
    WIDTH = wp.constant(of.samples)
    Reals: Any = wp.types.vector(length=of.samples, dtype=wp.float32)
    Controls: Any = wp.types.matrix(shape=(4, of.samples), dtype=wp.float32)
    States: Any = wp.types.matrix(shape=(10, of.samples), dtype=wp.float32)

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
        turn: wp.array2d(dtype=wp.vec3),
        nominal: wp.array3d(dtype=wp.vec4),
        controls: wp.array4d(dtype=Reals),
        positions: wp.array4d(dtype=Reals),
        cost: wp.array2d(dtype=Reals),
    ):
        """Stage I rollouts of noisy, clamped controls, and S1 without the terms that need the clearance.

        `controls` and `positions` have shapes [B M, N, 4, K] and [B M, N + PROBES, 3, K], in vectors of `of.samples`
        samples, as has `noise_table`, [N, 4, NOISE_ROWS]. Launched over [instances of this chunk, K / of.samples].
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
        p0 = position[b]
        v0 = velocity[b]
        q0 = quaternion[b]
        x = States()
        for j in range(WIDTH):
            for axis in range(3):
                x[axis, j] = p0[axis]
                x[3 + axis, j] = v0[axis]
            for axis in range(4):
                x[6 + axis, j] = q0[axis]
        noise = Controls()
        u = Controls()
        S = Reals()
        noisy = Reals(1.0)
        if group == 0 and c.keep_nominal != 0:
            noisy[0] = 0.0
        fresh = float(1.0)
        u_ahead = nominal[b, m, 0]
        p_ahead = guide[b, m, 1]
        drawn_ahead = Controls()
        for axis in range(4):
            drawn_ahead[axis] = noise_table[0, axis, row]
        for t in range(steps):
            u_nominal = u_ahead
            p_guide = p_ahead
            drawn = drawn_ahead
            # Read ahead, so that a GPU does not wait for memory at every step.
            ahead = wp.min(t + 1, steps - 1)
            u_ahead = nominal[b, m, ahead]
            p_ahead = guide[b, m, ahead + 1]
            for axis in range(4):
                drawn_ahead[axis] = noise_table[ahead, axis, row]
            # J_ctrl leaves out the last control, and the change to the first.
            counted = wp.where(t < steps - 1, 1.0, 0.0)
            change_counted = wp.where(t > 0, counted, 0.0)
            for j in range(WIDTH):
                # AR(1) with the variance of its innovations scaled to keep the noise's own.
                e = c.correlation * wp.vec4(noise[0, j], noise[1, j], noise[2, j], noise[3, j]) + fresh * wp.vec4(
                    drawn[0, j], drawn[1, j], drawn[2, j], drawn[3, j]
                )
                u_t = clamp_control(u_nominal + noisy[j] * wp.cw_mul(sigma, e), c)
                u_before = wp.vec4(u[0, j], u[1, j], u[2, j], u[3, j])
                p = wp.vec3(x[0, j], x[1, j], x[2, j])
                v = wp.vec3(x[3, j], x[4, j], x[5, j])
                q = wp.vec4(x[6, j], x[7, j], x[8, j], x[9, j])
                p, v, q = rk4_step(p, v, q, u_t, c.mass, c.gravity, c.dt)
                S[j] = (
                    S[j]
                    + counted * control_cost(u_t, c)
                    + change_counted * control_rate_cost(u_t, u_before, c)
                    + track * track_cost(p, p_guide, c)
                    + vnorm_cost(v, c)
                    + goal_cost(p, v, q, p_goal, v_goal, q_goal, c)
                    + speed_cost(v, c)
                )
                for axis in range(4):
                    noise[axis, j] = e[axis]
                    u[axis, j] = u_t[axis]
                    x[6 + axis, j] = q[axis]
                for axis in range(3):
                    x[axis, j] = p[axis]
                    x[3 + axis, j] = v[axis]
            fresh = wp.sqrt(1.0 - c.correlation * c.correlation)
            for axis in range(4):
                controls[i, t, axis, group] = u[axis]
            for axis in range(3):
                positions[i, t, axis, group] = x[axis]
        cost[i, group] = S
        if c.q_blocked > 0.0:
            for piece in range(PROBES):
                for j in range(WIDTH):
                    place = probe(wp.vec3(x[0, j], x[1, j], x[2, j]), turn[b, m], p_goal, piece, c)
                    for axis in range(3):
                        u[axis, j] = place[axis]
                for axis in range(3):
                    positions[i, steps + piece, axis, group] = u[axis]

    return of.tune(sample_rollouts)


@functools.cache
def improve(of: Widths) -> wp.Kernel:
    """Return the kernel for blocks of `of.improve` threads, which add `of.sums` samples at a time."""
    team = min(of.improve, 32)
    THREADS, WIDTH, TEAM = wp.constant(of.improve), wp.constant(of.sums), wp.constant(team)
    least_of_all, sum_of_team = least_of(of.improve), sum_of(team)
    Reals: Any = wp.types.vector(length=of.sums, dtype=wp.float32)
    Sums: Any = wp.types.matrix(shape=(AT_ONCE, of.sums), dtype=wp.float32)
    read = read_group(of.sums)

    @wp.kernel(module="unique", enable_backward=False)
    def improve(
        first: int,
        instances: int,
        goal_position: wp.array(dtype=wp.vec3),
        turn: wp.array2d(dtype=wp.vec3),
        params: wp.array(dtype=Params),
        nominal: wp.array3d(dtype=float),
        sample_controls: wp.array3d(dtype=Reals),
        positions: wp.array4d(dtype=float),
        clearance_cost: wp.array3d(dtype=float),
        cost: wp.array2d(dtype=float),
        weight: wp.array2d(dtype=float),
        weights: wp.array2d(dtype=Reals),
        controls: wp.array3d(dtype=float),
    ):
        """Complete S1 by the terms that need the clearance, and update the nominal by the softmin of the samples.

        w_k = exp(-(S_k - min S) / lambda) / sum; controls = nominal + sum_k w_k (u_k - nominal): the noise as it acted,
        after the clamp. `nominal`, `controls` and `sample_controls` have steps and components in one axis; `weights` is
        `weight` in vectors, and 0 past the last sample.

        Launched over [instances of this chunk, of.improve], a block for each instance.
        """
        offset, lane = wp.tid()
        i = first + offset
        b = i // instances
        m = i % instances
        samples = clearance_cost.shape[2]
        values = sample_controls.shape[1]
        steps = values // 4
        rows = wp.where(params[b].q_blocked > 0.0, clearance_cost.shape[1], steps)
        least = float(wp.INF)
        for k in range(lane, samples, THREADS):
            S = cost[i, k]
            last = wp.vec3(positions[i, steps - 1, 0, k], positions[i, steps - 1, 1, k], positions[i, steps - 1, 2, k])
            J_col = float(0.0)
            blocked = float(0.0)
            for t in range(0, rows, AT_ONCE):
                for j in range(AT_ONCE):
                    term = wp.where(t + j < rows, clearance_cost[i, wp.min(t + j, rows - 1), k], 0.0)
                    if t + j < steps:
                        J_col += term
                    else:
                        blocked += term
            S += J_col
            if params[b].q_blocked > 0.0:
                S += blocked_cost(last, turn[b, m], goal_position[b], int(blocked), params[b])
            cost[i, k] = S
            least = wp.min(least, S)
        least = least_of_all(least)
        for k in range(lane, samples, THREADS):
            weight[i, k] = wp.exp((least - cost[i, k]) / params[b].temperature)
        wait_for_block()
        # A team of threads for some values, whose neighbours read neighbouring samples.
        thread = lane % TEAM
        total = float(0.0)
        for group in range(thread, weights.shape[1], TEAM):
            w_group = weights[i, group]
            for k in range(WIDTH):
                total += w_group[k]
        total = sum_of_team(total)
        for first_value in range(lane // TEAM * AT_ONCE, values, THREADS // TEAM * AT_ONCE):
            u = Some()
            du = Sums()
            for j in range(AT_ONCE):
                u[j] = nominal[b, m, wp.min(first_value + j, values - 1)]
            for group in range(thread, weights.shape[1], TEAM):
                w_group = weights[i, group]
                for j in range(AT_ONCE):
                    u_group = read(sample_controls, i, wp.min(first_value + j, values - 1), group)
                    for k in range(WIDTH):
                        du[j, k] += w_group[k] * (u_group[k] - u[j])
            for j in range(AT_ONCE):
                change = float(0.0)
                for k in range(WIDTH):
                    change += du[j, k]
                change = sum_of_team(change)
                if thread == 0 and first_value + j < values:
                    controls[b, m, first_value + j] = u[j] + change / total

    return of.tune(improve)
