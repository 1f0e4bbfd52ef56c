"""The launches that turn the cloud into the spherical partition and the grid of points for clearance queries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from aero_planner.kernels import clearance, partition, shells, sweep_change
from aero_planner.launch_sequence import Chunk, LaunchSequence
from aero_planner.recorder import Recorder

_serial = LaunchSequence.serial


def stamp_sweep(r: Recorder) -> Callable[[], Any]:
    """Keep when and where the sweep that arrives was complete."""
    return r.record(sweep_change.stamp_sweep, (r.sizes.B,), inputs=[r.change, r.problem], outputs=[r.sweeps])


def thin_sweep(r: Recorder) -> Callable[[], Any]:
    """Remove most points of the sweep that is thinned."""
    inputs, size = [r.threads_per_sweep, r.change], (r.sizes.B, r.threads_per_sweep)
    return r.record(shells.thin_sweep, size, inputs=inputs, outputs=[r.sweeps])


def order_points(r: Recorder) -> list[Callable[[], Any]]:
    """Order the points of the sweeps that change by distance."""
    B, threads = r.sizes.B, r.threads_per_sweep
    return [
        r.record(kernel, size, inputs=inputs, outputs=[r.sweeps])
        for kernel, size, inputs in (
            (shells.start_shells, (B, 2), [r.change, r.problem, r.params]),
            (shells.count_shells, (B, 2, threads), [threads, r.change]),
            (shells.begin_shells, (B, 2), [r.change]),
            (shells.fill_shells, (B, 2, threads), [threads, r.change]),
        )
    ]


def scan_points(r: Recorder) -> list[Chunk]:
    """Find the nearest point of each fine cell; every worker scans its share of every sweep."""
    cloud, sizes, w = r.arrays.cloud, r.sizes, r.work
    sweeps, points = cloud.start.shape[0], cloud.points.shape[1]
    threads = r.tuning.threads_per_sweep(sizes.B * sweeps, points)
    return [
        _serial("partition", r.record(
            partition.scatter_points(r.tuning, r.composition),
            (sizes.B, sweeps, threads),
            inputs=[worker, threads * sizes.W, r.problem, r.sweeps, r.params, sizes.F0, sizes.F1, r.views],
            outputs=[w.cell_keys, w.worker_dropped],
        ))[0]
        for worker in range(sizes.W)
    ]  # fmt: skip


def finish_fine_cells(r: Recorder) -> list[Chunk]:
    """Merge the cells of all workers into ranges and the filtered cloud; every worker merges its share."""
    w, workers = r.work, r.sizes.W
    return [
        _serial("partition", r.record(
            partition.finish_fine_cells,
            r.threads_of_cells(workers),
            inputs=[worker, workers, r.tuning.cells_per_thread, r.problem, r.sweeps, r.params, w.cell_keys,
                    w.worker_dropped],
            outputs=[r.cells, r.outputs.dropped_points],
        ))[0]
        for worker in range(workers)
    ]  # fmt: skip


def build_clearance_grid(r: Recorder) -> list[Chunk]:
    """Sort the filtered cloud into the grid; every worker sorts the layers that are its own."""
    w, sizes, width = r.work, r.sizes, r.tuning.cells_per_thread
    workers, capacity, duplicate_rows = sizes.W, sizes.worker_capacity, r.batch_tuning.duplicate_rows
    chunks: list[Chunk] = []
    for worker in range(workers):
        worker_rows = len(range(worker, clearance.GRID, workers)) * clearance.GRID
        count = r.record(
            clearance.count_points,
            r.threads_of_cells(1),
            inputs=[worker, workers, width, r.problem, r.params, duplicate_rows, r.cells],
            outputs=[w.cell_ends],
        )
        allocate = r.record(
            clearance.allocate_rows,
            (sizes.B, -(-worker_rows // 32) * 32),
            inputs=[worker, workers, worker_rows, capacity],
            outputs=[w.points_used, w.cell_counts],
            block_dim=32,
        )
        fill = r.record(
            clearance.fill_rows(r.tuning),
            r.threads_of_cells(1),
            inputs=[
                worker, workers, capacity, width, r.problem, r.params, duplicate_rows, r.cells, w.points_used,
            ],
            outputs=[w.cell_ends, w.pack_coordinates],
        )  # fmt: skip
        chunks += _serial("grid", count, allocate, fill)
    return chunks


def pool_coarse_cells(r: Recorder) -> Callable[[], Any]:
    """Find range and safe direction of each coarse cell."""
    return r.record(
        partition.pool_coarse,
        (r.sizes.B, r.sizes.C),
        inputs=[r.cells, r.work.initial_directions],
        outputs=[r.outputs.safe_range, r.outputs.safe_direction],
        block_dim=32,
    )
