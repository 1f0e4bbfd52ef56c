"""The stages that turn the cloud into the spherical partition and the grid of points for clearance queries."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from aero_planner.arrays import Sizes
from aero_planner.config import PlannerConfig
from aero_planner.kernels import clearance, continuation, partition
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.launch_sequence import Chunk, LaunchSequence
from aero_planner.pipeline_records import PipelineArrays


class CloudStages:
    """Records the launches of these stages; `Pipeline` says in which order they run.

    Args:
        sequence: sequence of which the launches are part.
        config: configuration, of which only the structure is used.
        sizes: sizes of the arrays.
        tuning: tuning of the device for one drone.
        arrays: arrays of the planner.

    Attributes:
        duplicate_rows: as in the tuning for the batch.
    """

    def __init__(
        self,
        sequence: LaunchSequence,
        config: PlannerConfig,
        sizes: Sizes,
        tuning: KernelTuning,
        arrays: PipelineArrays,
    ) -> None:
        self.duplicate_rows = tuning.for_batch(sizes.B).duplicate_rows
        self._record, self._serial = sequence.record, sequence.serial
        self._config, self._sizes, self._tuning = config, sizes, tuning
        self._inputs, self._outputs, self._work = arrays.inputs, arrays.outputs, arrays.work
        self._cloud, self._params = arrays.cloud, arrays.params

    def scan_points(self) -> list[Chunk]:
        """Find the nearest point of each fine cell; every worker scans its share of every sweep."""
        i, w, cloud = self._inputs, self._work, self._cloud
        B, sweeps, points = self._sizes.B, cloud.start.shape[0], cloud.points.shape[1]
        threads = self._tuning.threads_per_sweep(B * sweeps, points)
        return [
            self._serial("partition", self._record(
                partition.scatter_points(self._tuning),
                (B, sweeps, threads),
                inputs=[
                    worker, threads * self._sizes.W, w.finished, cloud.bundle(), i.position, i.quaternion, self._params,
                    self._sizes.F0, self._sizes.F1,
                ],
                outputs=[w.cell_keys, w.worker_dropped],
            ))[0]
            for worker in range(self._sizes.W)
        ]  # fmt: skip

    def finish_fine_cells(self) -> list[Chunk]:
        """Merge the cells of all workers into ranges and the filtered cloud; every worker merges its share."""
        o, w, width = self._outputs, self._work, self._tuning.cells_per_thread
        return self._shared(
            partition.finish_fine_cells,
            self._threads(self._sizes.W),
            inputs=[width, self._cloud.bundle(), self._params, w.cell_keys, w.worker_dropped],
            outputs=[o.fine_range, o.occupied, o.filtered_points, o.dropped_points],
        )

    def find_surfaces(self) -> list[Chunk]:
        """Find the surfaces to continue; every worker looks at its share of the cells."""
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        return self._shared(
            continuation.find_edges(self._tuning),
            self._threads(sizes.W),
            inputs=[
                i.position, i.velocity, i.quaternion, self._params, sizes.F0, sizes.F1, w.view_quaternion,
                w.fine_directions.flatten(), o.occupied, o.filtered_points,
            ],
            outputs=[w.surfaces],
        )  # fmt: skip

    def find_nearest_surfaces(self) -> list[Chunk]:
        """Find the nearest surface above and below each cell; every worker looks at its share of the columns."""
        sizes = self._sizes
        return self._shared(
            continuation.find_nearest_surfaces,
            (sizes.B, 2, -(-sizes.F1 // sizes.W)),
            inputs=[self._params, sizes.F0, sizes.F1],
            outputs=[self._work.surfaces],
            block_dim=32,
        )

    def continue_surfaces(self) -> list[Chunk]:
        """Fill cells that the sensor does not see; every worker fills its share."""
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        return self._shared(
            continuation.continue_surfaces(self._tuning),
            self._threads(sizes.W),
            inputs=[
                i.position, i.quaternion, self._params, sizes.F0, sizes.F1, w.fine_directions.flatten(), w.surfaces,
            ],
            outputs=[o.fine_range, o.occupied, o.filtered_points],
        )  # fmt: skip

    def _shared(
        self, kernel: Any, size: tuple[int, ...], *, inputs: list[Any], outputs: list[Any], block_dim: int = 256
    ) -> list[Chunk]:
        """Record a launch for every worker; its number and the number of workers come before `inputs`."""
        workers = self._sizes.W
        launches = [
            self._record(kernel, size, inputs=[worker, workers, *inputs], outputs=outputs, block_dim=block_dim)
            for worker in range(workers)
        ]
        return [chunk for launch in launches for chunk in self._serial("partition", launch)]

    def _threads(self, workers: int) -> tuple[int, int]:
        """Return the size of a launch in which the threads of `workers` workers share the fine cells."""
        return self._sizes.B, -(-self._sizes.F // (workers * self._tuning.cells_per_thread))

    def build_clearance_grid(self) -> list[Chunk]:
        """Sort the filtered cloud into the grid; every worker sorts the layers that are its own."""
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        workers, capacity = sizes.W, sizes.worker_capacity
        chunks: list[Chunk] = []
        for worker in range(workers):
            worker_rows = len(range(worker, clearance.GRID, workers)) * clearance.GRID
            count = self._record(
                clearance.count_points,
                self._threads(1),
                inputs=[
                    worker, workers, self._tuning.cells_per_thread, i.position, self._params, self.duplicate_rows,
                    o.occupied, o.filtered_points,
                ],
                outputs=[w.cell_ends],
            )  # fmt: skip
            allocate = self._record(
                clearance.allocate_rows,
                (sizes.B, -(-worker_rows // 32) * 32),
                inputs=[worker, workers, worker_rows, capacity],
                outputs=[w.points_used, w.cell_counts],
                block_dim=32,
            )
            fill = self._record(
                clearance.fill_rows(self._tuning),
                self._threads(1),
                inputs=[
                    worker, workers, capacity, self._tuning.cells_per_thread, i.position, self._params,
                    self.duplicate_rows, o.occupied, o.filtered_points, w.points_used,
                ],
                outputs=[w.cell_ends, w.pack_coordinates],
            )  # fmt: skip
            chunks += self._serial("grid", count, allocate, fill)
        return chunks

    def pool_coarse_cells(self) -> Callable[[], Any]:
        """Find range and safe direction of each coarse cell."""
        o, w, part = self._outputs, self._work, self._config.partition
        return self._record(
            partition.pool_coarse,
            (self._sizes.B, self._sizes.C),
            inputs=[
                part.fine_cells, part.coarse_rows, part.coarse_columns, o.fine_range, w.fine_directions,
                w.initial_directions,
            ],
            outputs=[o.safe_range, o.safe_direction],
            block_dim=32,
        )  # fmt: skip
