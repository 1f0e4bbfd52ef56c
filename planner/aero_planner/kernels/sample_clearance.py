"""Clearance of all Stage I positions, and its cost."""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Problem, grid_struct
from aero_planner.kernels.clearance import (
    GRID,
    ROUNDING,
    above_ground,
    cell_size,
    clearance_at,
    grid_coordinates,
    query_limit,
    scan_packs,
    smallest,
)

wp.set_module_options({"enable_backward": False})


def query_clearance(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that evaluates the clearance of all Stage I positions, one by one or by vectors of samples."""
    return (_query_one_by_one if tuning.samples_per_thread == 1 else _query_vectors)(tuning, composition)


@functools.cache
def _query_one_by_one(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    ROWS, THREADS = wp.constant(tuning.rows_per_sample_query), wp.constant(tuning.threads_per_sample_query)
    clearance = clearance_at(tuning.points_per_pack, tuning.threads_per_sample_query)
    Grid: Any = grid_struct(tuning.points_per_pack)
    Views, dynamic, obstacle_cost = composition.Views, composition.hooks.clearance, composition.obstacle

    # For a batch, limits the registers so that a multiprocessor holds eight blocks. One drone does not fill it anyway.
    bounds = (128, 8) if tuning.rows_per_sample_query > 1 else None

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=bounds)
    def query_clearance(
        # slice of the instances
        first_instance: int,
        instances: int,
        steps: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        grid: Grid,
        views: Views,
        sample_positions: wp.array4d(dtype=float),
        # out
        sample_clearance_cost: wp.array3d(dtype=float),
    ):
        """Compute the collision cost of every sampled position, shape [B M, N + PROBES, K].

        Rows from `steps` on are probes of the cost-to-go: 1 where the path is blocked, else 0.
        Launched over [instances of this chunk, groups of ROWS rows, K THREADS].
        """
        offset, group, slot = wp.tid()
        k = slot // THREADS
        thread = slot % THREADS
        i = first_instance + offset
        b = i // instances
        if problem.active[b] == 0:
            return
        c = params[b]
        rows = wp.where(c.q_blocked == 0.0, steps, sample_clearance_cost.shape[1])
        v = problem.velocity[b]
        size = cell_size(v, c)
        for t in range(group * ROWS, wp.min(group * ROWS + ROWS, rows)):
            limit = query_limit(t, steps, v, c)
            x = wp.vec3(sample_positions[i, t, 0, k], sample_positions[i, t, 1, k], sample_positions[i, t, 2, k])
            d = clearance(x, limit, b, thread, problem.position[b], size, grid)
            d = above_ground(d, x, problem.ground_height[b], c)
            if t < steps:
                d = dynamic(d, x, float(t + 1) * c.dt, b, views, c)
            if thread == 0:
                blocked = wp.where(d < c.distance_min, 1.0, 0.0)
                sample_clearance_cost[i, t, k] = wp.where(t < steps, obstacle_cost(d, c), blocked)

    return tuning.set_options(query_clearance)


@functools.cache
def _query_vectors(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel for vectors of samples.

    Most positions are far from all points. Their cells and their costs are found for a vector at once, and only the
    others are compared with points one by one. The rows of the grid must be duplicated.
    """
    WIDTH, PACK = wp.constant(tuning.samples_per_thread), wp.constant(tuning.points_per_pack)
    scan, reduce = scan_packs(tuning.points_per_pack, 1), smallest(tuning.points_per_pack)
    Reals: Any = wp.types.vector(length=tuning.samples_per_thread, dtype=wp.float32)
    Integers: Any = wp.types.vector(length=tuning.samples_per_thread, dtype=wp.int32)
    Distances: Any = wp.types.vector(length=tuning.points_per_pack, dtype=wp.float32)
    Grid: Any = grid_struct(tuning.points_per_pack)
    Views, dynamic, obstacle_cost = composition.Views, composition.hooks.clearance, composition.obstacle

    @wp.kernel(module="unique", enable_backward=False)
    def query_vectors(
        # slice of the instances
        first_instance: int,
        instances: int,
        steps: int,
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        grid: Grid,
        views: Views,
        sample_positions: wp.array4d(dtype=Reals),
        # out
        sample_clearance_cost: wp.array3d(dtype=float),
    ):
        """Compute the collision cost of every sampled position. Launched over [instances of this chunk, N + PROBES, 1].

        The results are those of the kernel that queries one by one.
        """
        offset, t, _ = wp.tid()
        i = first_instance + offset
        b = i // instances
        if problem.active[b] == 0:
            return
        c = params[b]
        if t >= steps and c.q_blocked == 0.0:
            return
        samples = sample_clearance_cost.shape[2]
        center = problem.position[b]
        v = problem.velocity[b]
        ground = problem.ground_height[b]
        limit = query_limit(t, steps, v, c)
        size = cell_size(v, c)
        reach = limit / size + ROUNDING  # in cells
        first_cell = Integers()
        last_cell = Integers()
        cost = Reals()
        for group in range((samples + WIDTH - 1) // WIDTH):
            xs = sample_positions[i, t, 0, group]
            ys = sample_positions[i, t, 1, group]
            zs = sample_positions[i, t, 2, group]
            nearest = Reals(limit * limit)
            for j in range(WIDTH):
                cell = grid_coordinates(wp.vec3(xs[j], ys[j], zs[j]), center, size)
                row = (int(cell[2]) * GRID + int(cell[1])) * GRID
                # The first cell of a row is empty, so its end is the begin of the row.
                inside = wp.min(cell) >= 0.0 and wp.max(cell) < float(GRID)
                first_cell[j] = wp.where(inside, row + int(wp.max(cell[0] - reach - 1.0, 0.0)), 0)
                last_cell[j] = wp.where(inside, row + int(wp.min(cell[0] + reach, float(GRID - 1))), 0)
            for j in range(WIDTH):
                first = grid.ends[b, first_cell[j]]
                last = grid.ends[b, last_cell[j]]
                if first < last:
                    x = wp.vec3(xs[j], ys[j], zs[j])
                    best = Distances(limit * limit)
                    end = (last + PACK - 1) // PACK
                    nearest[j] = reduce(scan(best, x, b, first // PACK, end, grid.packs))
            for j in range(WIDTH):
                d = wp.where(nearest[j] < limit * limit, wp.sqrt(nearest[j]), limit)
                x = wp.vec3(xs[j], ys[j], zs[j])
                d = above_ground(d, x, ground, c)
                if t < steps:
                    d = dynamic(d, x, float(t + 1) * c.dt, b, views, c)
                blocked = wp.where(d < c.distance_min, 1.0, 0.0)
                cost[j] = wp.where(t < steps, obstacle_cost(d, c), blocked)
            for j in range(wp.min(WIDTH, samples - group * WIDTH)):
                sample_clearance_cost[i, t, group * WIDTH + j] = cost[j]

    return tuning.set_options(query_vectors, keep_loops=True)
