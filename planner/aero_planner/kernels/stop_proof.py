"""Proof that a candidate can be stopped.

A candidate is flyable if at least one of its stops is clear. The controls of that stop are kept. If no candidate of the
next plan is flyable, the drone flies the kept stop, which is still clear unless new points have appeared.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.movers import Movers, clear_of_movers
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, Rollouts
from aero_planner.kernels.stops import (
    STOPS,
    is_hidden,
    mover_allowances,
    roll_out_stop,
    safe_clearances,
    switch_step,
    widest_stop_limit,
)
from aero_planner.kernels.warp_ops import point_pack

wp.set_module_options({"enable_backward": False})


@functools.cache
def clearance_of_stop(tuning: KernelTuning) -> wp.Function:
    """Return the function that finds the clearance of a stop over a range of its positions [m]."""
    clearance_of = clearance_at(tuning.points_per_pack, tuning.threads_per_stop_query)
    Pack: Any = point_pack(tuning.points_per_pack)

    @wp.func
    def clearance_of_stop(
        b: int,
        i: int,
        first: int,
        end: int,
        floor: float,
        thread: int,
        c: Params,
        position: wp.vec3,
        quaternion: wp.vec4,
        ground_height: float,
        movers: Movers,
        probes: int,
        duplicate_rows: int,
        rows: int,
        columns: int,
        fine_range: wp.array2d(dtype=float),
        positions: wp.array3d(dtype=wp.vec3),
        plan_period: float,
        cell_ends: wp.array2d(dtype=int),
        point_packs: wp.array2d(dtype=Pack),
        stop_positions: wp.array3d(dtype=wp.vec3),
        state_terms: wp.array3d(dtype=wp.vec4),
        standing_clearance: wp.array3d(dtype=float),
        allowance: float,
    ) -> float:
        """Return the least clearance of the positions `first` to `end` - 1 of stop i, or the first one below `floor`.

        Its 4 N positions are states and midpoints: the first half those of the braking manoeuvre, the others those of
        the candidate before the switch. What moves counts as farther away by `allowance`, the second of
        `mover_allowances`. The result is at most safe_clearance.
        """
        steps = stop_positions.shape[2] - 1
        least = float(c.safe_clearance)
        for row in range(first, end):
            if least >= floor:
                d = float(c.safe_clearance)
                x = position
                if row < 2 * steps:
                    t = row // 2
                    x = stop_positions[b, i, t + 1]
                    if row % 2 == 1:
                        x = 0.5 * (x + stop_positions[b, i, t])
                    margin = c.speed_margin * wp.length(stop_positions[b, i, t + 1] - stop_positions[b, i, t]) / c.dt
                    limit = wp.min(c.safe_clearance + margin, cell_size(c))
                    d = clearance_of(
                        x, limit, b, thread, position, cell_size(c), duplicate_rows, cell_ends, point_packs
                    )
                    d = above_ground(d, x, ground_height, c)
                    time = float(switch_step(i % STOPS, steps, plan_period, c)) + 0.5 * float(t * 2 + 2 - row % 2)
                    d = wp.min(d, clear_of_movers(wp.INF, x, time * c.dt, b, movers, c) + allowance) - margin
                else:
                    t = (row - 2 * steps) // 2
                    if t < switch_step(i % STOPS, steps, plan_period, c):
                        # state_terms holds N states, the probes, N midpoints and the start.
                        m = i // STOPS
                        x = positions[b, m, t + 1]
                        state = wp.where(row % 2 == 0, t, steps + probes + t)
                        d = wp.min(standing_clearance[b, m, state], state_terms[b, m, state][3] + allowance)
                if c.stop_seen != 0 and row % 2 == 0:
                    hidden = is_hidden(b, x, position, quaternion, rows, columns, c, fine_range)
                    d = wp.where(hidden, 0.0, d)
                least = wp.min(least, d)
        return least

    return clearance_of_stop


@functools.cache
def evaluate_stops(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that finds the clearance of all stops.

    `tuning.threads_per_stop_query` threads share a position.
    """
    clearance = clearance_of_stop(tuning)
    Pack: Any = point_pack(tuning.points_per_pack)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_stops(
        # problem
        finished: wp.array(dtype=int),
        position: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.vec4),
        ground_height: wp.array(dtype=float),
        movers: Movers,
        # configuration
        params: wp.array(dtype=Params),
        probes: int,
        duplicate_rows: int,
        rows: int,
        columns: int,
        # in
        fine_range: wp.array2d(dtype=float),
        positions: wp.array3d(dtype=wp.vec3),
        plan_period: wp.array(dtype=float),
        cell_ends: wp.array2d(dtype=int),
        point_packs: wp.array2d(dtype=Pack),
        stop_positions: wp.array3d(dtype=wp.vec3),
        state_terms: wp.array3d(dtype=wp.vec4),
        standing_clearance: wp.array3d(dtype=float),
        # in and out
        stop_clearance: wp.array2d(dtype=float),
    ):
        """Lower the clearance of every stop to the least of its states and midpoints.

        The states of the candidate before the switch count as well.
        Launched over [B, stops, 4 N, threads per query].
        """
        b, i, row, thread = wp.tid()
        if finished[b] != 0:
            return
        c = params[b]
        if c.prove_stop == 0:
            return
        start = state_terms.shape[2] - 1
        _, allowance = mover_allowances(state_terms[b, 0, start][3], standing_clearance[b, 0, start], c)
        d = clearance(
            b, i, row, row + 1, 0.0, thread, c, position[b], quaternion[b], ground_height[b], movers, probes,
            duplicate_rows, rows, columns, fine_range, positions, plan_period[b], cell_ends, point_packs,
            stop_positions, state_terms, standing_clearance, allowance,
        )  # fmt: skip
        if thread == 0 and d < c.safe_clearance:
            wp.atomic_min(stop_clearance, b, i, d)

    return tuning.set_options(evaluate_stops, keep_loops=True)


@functools.cache
def prove_stops(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that does the work of `roll_out_stops` and `evaluate_stops` as far as the selection needs it.

    It is serial, for a CPU; a GPU has idle threads for all stops.
    """
    clearance = clearance_of_stop(tuning)
    Pack: Any = point_pack(tuning.points_per_pack)

    @wp.kernel(module="unique", enable_backward=False)
    def prove_stops(
        # problem
        finished: wp.array(dtype=int),
        drone: DroneState,
        position: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.vec4),
        ground_height: wp.array(dtype=float),
        movers: Movers,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        probes: int,
        duplicate_rows: int,
        rows: int,
        columns: int,
        # in
        fine_range: wp.array2d(dtype=float),
        plan_period: wp.array(dtype=float),
        rollouts: Rollouts,
        cell_ends: wp.array2d(dtype=int),
        point_packs: wp.array2d(dtype=Pack),
        state_terms: wp.array3d(dtype=wp.vec4),
        standing_clearance: wp.array3d(dtype=float),
        instance_scores: wp.array2d(dtype=wp.vec3),
        stop_ready: wp.array(dtype=int),
        # out
        stop_controls: wp.array3d(dtype=wp.vec4),
        stop_positions: wp.array3d(dtype=wp.vec3),
        stop_clearance: wp.array2d(dtype=float),
    ):
        """Look for the first clear stop of the candidates in the order of their costs, until one is safe.

        If none is, and no braking candidate is clear of what stands either, look for the stop with the largest
        clearance. That of other stops is only known to be too small. Launched over [B].
        """
        b = wp.tid()
        if finished[b] != 0:
            return
        c = params[b]
        if c.prove_stop == 0:
            return
        for i in range(instances * STOPS):
            stop_clearance[b, i] = -wp.INF
        start = state_terms.shape[2] - 1
        safe, stop_safe = safe_clearances(standing_clearance[b, 0, start], c)
        _, allowance = mover_allowances(state_terms[b, 0, start][3], standing_clearance[b, 0, start], c)
        count = 4 * (stop_positions.shape[2] - 1)
        cost = float(-wp.INF)
        m = int(-1)
        for _rank in range(instances):
            # The next candidate by cost; of equal costs the first one.
            following = int(-1)
            for k in range(instances):
                S = instance_scores[b, k][0]
                is_left = cost < S or (cost == S and k > m)
                if is_left and (following < 0 or instance_scores[b, following][0] > S):
                    following = k
            if following < 0:
                return
            m = following
            cost = instance_scores[b, m][0]
            if c.prove_stop == 2 or instance_scores[b, m][1] >= safe:
                for j in range(STOPS):
                    i = m * STOPS + j
                    roll_out_stop(b, i, drone, c, plan_period, rollouts, stop_controls, stop_positions, stop_clearance)
                for j in range(STOPS):
                    i = m * STOPS + j
                    if stop_clearance[b, i] >= stop_safe:
                        stop_clearance[b, i] = clearance(
                            b, i, 0, count, stop_safe, 0, c, position[b], quaternion[b], ground_height[b],
                            movers, probes, duplicate_rows, rows, columns, fine_range, rollouts.positions,
                            plan_period[b], cell_ends, point_packs, stop_positions, state_terms, standing_clearance,
                            allowance,
                        )  # fmt: skip
                        if stop_clearance[b, i] >= stop_safe:
                            return
            if c.prefer_safe == 0:
                return
        widest = widest_stop_limit(stop_safe, c)
        for k in range(instances, instance_scores.shape[1] - wp.where(stop_ready[b] != 0, 0, 1)):
            if instance_scores[b, k][2] >= stop_safe:
                return
            widest = wp.max(widest, instance_scores[b, k][1])
        for i in range(instances * STOPS):
            if stop_clearance[b, i] > widest:
                stop_clearance[b, i] = clearance(
                    b, i, 0, count, widest, 0, c, position[b], quaternion[b], ground_height[b], movers, probes,
                    duplicate_rows, rows, columns, fine_range, rollouts.positions, plan_period[b], cell_ends,
                    point_packs, stop_positions, state_terms, standing_clearance, allowance,
                )  # fmt: skip
                widest = wp.max(widest, stop_clearance[b, i])

    return tuning.set_options(prove_stops, keep_loops=True)
