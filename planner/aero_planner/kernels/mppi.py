"""Model predictive path integral control, Stage I: sampling, rollouts, weights, update.

Instance i = b M + m is instance m of drone b. Samples k are the last axis of sampled arrays, so that neighbouring
samples are neighbours in memory, for the threads of a GPU and for the vectors of a CPU.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.costs.cost_term import End, Step
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Problem, Start
from aero_planner.device.warp_ops import minimum_over, read_values, sum_over, synchronize_block

wp.set_module_options({"enable_backward": False})

NOISE_ROWS = wp.constant(16384)
"""Noise sequences in the table, which is drawn once: drawing anew would take most of a rollout's time on a CPU. The
samples of an instance use consecutive sequences from a random first one on, with random signs. They are independent of
each other, and the same combination recurs only after thousands of plans."""

NOISE_STEP = wp.constant(64)
"""The first sequence is a multiple of this number, which the samples per thread divide."""

READ_AHEAD = wp.constant(7)
"""Control values that are read together, so that a GPU waits for memory less often."""
COSTS_READ = wp.constant(9)
"""Costs of a sample that are read together, for the same reason."""

BISECTIONS = wp.constant(12)
"""Of the logarithm of the temperature, which give it to 0.3 %."""
LOWEST_TEMPERATURE = wp.constant(-11.5)
"""Logarithm of the lowest temperature as a share of the largest one, 1e-5."""

Values: Any = wp.types.vector(length=READ_AHEAD, dtype=wp.float32)

PROBES = wp.constant(10)
"""Positions on the path from the final state to the goal at which the cost-to-go checks for obstacles."""


@wp.kernel
def fill_noise(noise: wp.array3d(dtype=float)):
    """Draw white noise of unit variance, shape [N, 4, NOISE_ROWS]. Launched over [N, NOISE_ROWS]."""
    t, row = wp.tid()
    random = wp.rand_init(20509, t * noise.shape[2] + row)
    for i in range(4):
        noise[t, i, row] = wp.randn(random)


@wp.func
def random_sign(bits: int, i: int) -> float:
    """Return -1 or 1 by the i-th bit."""
    return float(1 - 2 * ((bits >> i) & 1))


@wp.func
def probe_position(p: wp.vec3, goal: wp.vec3, j: int, params: Params) -> wp.vec3:
    """Return the centre of segment j of the straight path from p to the goal, as far as the look-ahead distance."""
    to_goal = goal - p
    distance = wp.length(to_goal)
    s = (float(j) + 0.5) / float(PROBES) * wp.min(params.lookahead, distance)
    return p + (s / wp.max(distance, 1.0e-6)) * to_goal


@functools.cache
def sample_rollouts(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that rolls out the samples, `tuning.samples_per_thread` in each thread."""
    WIDTH = wp.constant(tuning.samples_per_thread)
    Reals: Any = wp.types.vector(length=tuning.samples_per_thread, dtype=wp.float32)
    Controls: Any = wp.types.matrix(shape=(4, tuning.samples_per_thread), dtype=wp.float32)
    States: Any = wp.types.matrix(shape=(10, tuning.samples_per_thread), dtype=wp.float32)
    model, running_cost = composition.model, composition.running1
    constants, step, clamp, deviation = model.constants, model.step, model.clamp, model.noise

    @wp.kernel(module="unique", enable_backward=False)
    def sample_rollouts(
        # slice of the instances
        first_instance: int,
        instances: int,
        previous_index: int,
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        # in
        seed: wp.array(dtype=int),
        tick: wp.array(dtype=int),
        noise_table: wp.array3d(dtype=Reals),
        guides: wp.array3d(dtype=wp.vec3),
        nominal_controls: wp.array3d(dtype=wp.vec4),
        # out
        sample_controls: wp.array4d(dtype=Reals),
        sample_positions: wp.array4d(dtype=Reals),
        stage1_cost: wp.array2d(dtype=Reals),
    ):
        """Roll out noisy, clamped controls and sum the running terms of S1.

        Samples come in vectors of WIDTH: `sample_controls` is [B M, N, 4, K], `sample_positions` [B M, N + PROBES, 3,
        K], `noise_table` [N, 4, NOISE_ROWS]. Launched over [instances of this chunk, K / WIDTH].
        """
        offset, group = wp.tid()
        i = first_instance + offset
        b = i // instances
        if problem.active[b] == 0:
            return
        m = i % instances
        c = params[b]
        steps = sample_controls.shape[1]
        bits = int(wp.rand_init(seed[b] + 7919 * tick[b], m) & wp.uint32(0x7FFFFFFF))
        row = (bits % (NOISE_ROWS // NOISE_STEP) * (NOISE_STEP // WIDTH) + group) % (NOISE_ROWS // WIDTH)
        signs = wp.vec4(random_sign(bits, 16), random_sign(bits, 17), random_sign(bits, 18), random_sign(bits, 19))
        sigma = wp.cw_mul(signs, deviation(c))
        s = Step()
        s.last = steps - 1
        s.is_guided = wp.where(m == previous_index, 0, 1)
        s.p_goal = problem.goal[b]
        s.v_goal = start.goal_velocity[b]
        s.q_goal = start.goal_quaternion[b]
        p0 = start.position[b]
        v0 = start.velocity[b]
        q0 = start.quaternion[b]
        x = States()
        for j in range(WIDTH):
            for axis in range(3):
                x[axis, j] = p0[axis]
                x[3 + axis, j] = v0[axis]
            for axis in range(4):
                x[6 + axis, j] = q0[axis]
        k = constants(start.disturbance[b], start.drag[b], c.dt, c)
        noise = Controls()
        u = Controls()
        acting = Controls()
        for j in range(WIDTH):
            for axis in range(4):
                acting[axis, j] = start.control[b][axis]
                u[axis, j] = start.command[b][axis]
        S = Reals()
        # Where jumps have a price, a sample without noise lets commands continue if no other one is better.
        noisy = Reals(1.0)
        if group == 0 and c.q_control_jump > 0.0:
            noisy[0] = 0.0
        innovation = wp.sqrt(1.0 - c.correlation * c.correlation)
        u_next = nominal_controls[b, m, 0]
        p_next = guides[b, m, 1]
        drawn_next = Controls()
        for axis in range(4):
            drawn_next[axis] = noise_table[0, axis, row]
        for t in range(steps):
            u_nominal = u_next
            s.t = t
            s.p_guide = p_next
            drawn = drawn_next
            # The next step is read in advance, so that a GPU does not wait for memory at every step.
            t_next = wp.min(t + 1, steps - 1)
            u_next = nominal_controls[b, m, t_next]
            p_next = guides[b, m, t_next + 1]
            for axis in range(4):
                drawn_next[axis] = noise_table[t_next, axis, row]
            for j in range(WIDTH):
                # AR(1) noise from rest: of a plan's noise, little reaches the motors before the next plan.
                e = c.correlation * wp.vec4(noise[0, j], noise[1, j], noise[2, j], noise[3, j]) + innovation * wp.vec4(
                    drawn[0, j], drawn[1, j], drawn[2, j], drawn[3, j]
                )
                s.u = clamp(u_nominal + noisy[j] * wp.cw_mul(sigma, e), c)
                s.u_before = wp.vec4(u[0, j], u[1, j], u[2, j], u[3, j])
                p = wp.vec3(x[0, j], x[1, j], x[2, j])
                v = wp.vec3(x[3, j], x[4, j], x[5, j])
                q = wp.vec4(x[6, j], x[7, j], x[8, j], x[9, j])
                a = wp.vec4(acting[0, j], acting[1, j], acting[2, j], acting[3, j])
                p, v, q, a = step(p, v, q, a, s.u, k)
                s.p = p
                s.v = v
                s.q = q
                S[j] = S[j] + running_cost(s, c)
                for axis in range(4):
                    noise[axis, j] = e[axis]
                    u[axis, j] = s.u[axis]
                    acting[axis, j] = a[axis]
                    x[6 + axis, j] = q[axis]
                for axis in range(3):
                    x[axis, j] = p[axis]
                    x[3 + axis, j] = v[axis]
            for axis in range(4):
                sample_controls[i, t, axis, group] = u[axis]
            for axis in range(3):
                sample_positions[i, t, axis, group] = x[axis]
        stage1_cost[i, group] = S
        if c.q_blocked > 0.0:
            for segment in range(PROBES):
                for j in range(WIDTH):
                    position = probe_position(wp.vec3(x[0, j], x[1, j], x[2, j]), s.p_goal, segment, c)
                    for axis in range(3):
                        u[axis, j] = position[axis]
                for axis in range(3):
                    sample_positions[i, steps + segment, axis, group] = u[axis]

    return tuning.set_options(sample_rollouts)


@functools.cache
def find_temperature(lanes: int) -> wp.Function:
    """Return the function that finds the temperature of an instance, whose samples `lanes` threads share."""
    LANES = wp.constant(lanes)
    total = sum_over(lanes)

    @wp.func
    def effective_samples(
        stage1_cost: wp.array2d(dtype=float), i: int, samples: int, lowest: float, lane: int, temperature: float
    ) -> float:
        """Return (sum w)^2 / sum w^2 of the weights at a temperature."""
        w_sum = float(0.0)
        w_squares = float(0.0)
        for k in range(lane, samples, LANES):
            w = wp.exp((lowest - stage1_cost[i, k]) / temperature)
            w_sum += w
            w_squares += w * w
        w_sum = total(w_sum)
        return w_sum * w_sum / total(w_squares)

    @wp.func
    def find_temperature(
        stage1_cost: wp.array2d(dtype=float), i: int, samples: int, lowest: float, lane: int, params: Params
    ) -> float:
        """Return the temperature at which the weights have K_eff effective samples, at most `params.temperature`.

        The number grows with the temperature: the logarithm of the latter is found by bisection.
        """
        highest = params.temperature
        asked = params.effective_samples
        if asked == 0.0 or effective_samples(stage1_cost, i, samples, lowest, lane, highest) <= asked:
            return highest
        exponent = LOWEST_TEMPERATURE
        step = -0.5 * LOWEST_TEMPERATURE
        for _ in range(BISECTIONS):
            tried = highest * wp.exp(exponent + step)
            if effective_samples(stage1_cost, i, samples, lowest, lane, tried) <= asked:
                exponent += step
            step *= 0.5
        return highest * wp.exp(exponent)

    return find_temperature


@functools.cache
def update_controls(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that completes S1 and updates the nominal controls, with a thread block per instance."""
    lanes = min(tuning.threads_per_update, 32)
    shares = 4 if tuning.is_cuda else 1  # threads that share the costs of one sample
    THREADS, LANES, SHARES = wp.constant(tuning.threads_per_update), wp.constant(lanes), wp.constant(shares)
    WIDTH = wp.constant(tuning.samples_per_read)
    block_minimum, warp_sum, sum_of_shares = minimum_over(tuning.threads_per_update), sum_over(lanes), sum_over(shares)
    Reals: Any = wp.types.vector(length=tuning.samples_per_read, dtype=wp.float32)
    Sums: Any = wp.types.matrix(shape=(READ_AHEAD, tuning.samples_per_read), dtype=wp.float32)
    read = read_values(tuning.samples_per_read)
    Views, terminal_cost = composition.Views, composition.terminal1
    temperature_of = find_temperature(lanes)

    @wp.kernel(module="unique", enable_backward=False)
    def update_controls(
        # slice of the instances
        first_instance: int,
        instances: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        views: Views,
        nominal_controls: wp.array3d(dtype=float),
        sample_controls: wp.array3d(dtype=Reals),
        sample_positions: wp.array4d(dtype=float),
        sample_clearance_cost: wp.array3d(dtype=float),
        # in and out
        stage1_cost: wp.array2d(dtype=float),
        # out
        temperature: wp.array2d(dtype=float),
        sample_weights: wp.array2d(dtype=float),
        weight_vectors: wp.array2d(dtype=Reals),
        controls: wp.array3d(dtype=float),
    ):
        """Complete S1 by the terms that need the clearance, and update the nominal controls by the samples' softmin.

        w_k = exp(-(S_k - min S) / lambda) / sum; controls = nominal + sum_k w_k (u_k - nominal): the update uses the
        noise as it acted, after the clamp. Time steps and control components of `nominal_controls`, `controls` and
        `sample_controls` share an axis. `weight_vectors` is the memory of `sample_weights`, zero past the last sample.

        Launched over [instances of this chunk, THREADS], with a block of threads per instance.
        """
        offset, thread = wp.tid()
        i = first_instance + offset
        b = i // instances
        if problem.active[b] == 0:
            return
        m = i % instances
        samples = sample_clearance_cost.shape[2]
        values = sample_controls.shape[1]
        steps = values // 4
        rows = wp.where(params[b].q_blocked > 0.0, sample_clearance_cost.shape[1], steps)
        lowest = float(wp.INF)
        share = thread % SHARES
        e = End()
        e.b = b
        e.p_goal = problem.goal[b]
        for k in range(thread // SHARES, samples, THREADS // SHARES):
            S = stage1_cost[i, k]
            e.p = wp.vec3(
                sample_positions[i, steps - 1, 0, k],
                sample_positions[i, steps - 1, 1, k],
                sample_positions[i, steps - 1, 2, k],
            )
            J_col = float(0.0)
            blocked = float(0.0)
            for first in range(share, rows, SHARES * COSTS_READ):
                for j in range(COSTS_READ):
                    t = first + j * SHARES
                    term = wp.where(t < rows, sample_clearance_cost[i, wp.min(t, rows - 1), k], 0.0)
                    if t < steps:
                        J_col += term
                    else:
                        blocked += term
            S += sum_of_shares(J_col)
            blocked = sum_of_shares(blocked)
            if share == 0:  # one of the threads completes the cost, and uses it below
                e.blocked = blocked / float(PROBES)
                S += terminal_cost(e, views, params[b])
                stage1_cost[i, k] = S
                lowest = wp.min(lowest, S)
        lowest = block_minimum(lowest)
        synchronize_block()
        lane = thread % LANES
        softness = temperature_of(stage1_cost, i, samples, lowest, lane, params[b])
        if thread == 0:
            temperature[b, m] = softness
        if share == 0:
            for k in range(thread // SHARES, samples, THREADS // SHARES):
                sample_weights[i, k] = wp.exp((lowest - stage1_cost[i, k]) / softness)
        synchronize_block()
        # Each warp sums READ_AHEAD values at a time; its lanes read neighbouring samples.
        total = float(0.0)
        for group in range(lane, weight_vectors.shape[1], LANES):
            w_group = weight_vectors[i, group]
            for k in range(WIDTH):
                total += w_group[k]
        total = warp_sum(total)
        for first_value in range(thread // LANES * READ_AHEAD, values, THREADS // LANES * READ_AHEAD):
            u = Values()
            du = Sums()
            for j in range(READ_AHEAD):
                u[j] = nominal_controls[b, m, wp.min(first_value + j, values - 1)]
            for group in range(lane, weight_vectors.shape[1], LANES):
                w_group = weight_vectors[i, group]
                for j in range(READ_AHEAD):
                    u_group = read(sample_controls, i, wp.min(first_value + j, values - 1), group)
                    for k in range(WIDTH):
                        du[j, k] += w_group[k] * (u_group[k] - u[j])
            for j in range(READ_AHEAD):
                change = float(0.0)
                for k in range(WIDTH):
                    change += du[j, k]
                change = warp_sum(change)
                if lane == 0 and first_value + j < values:
                    controls[b, m, first_value + j] = u[j] + change / total

    return tuning.set_options(update_controls)
