"""The pipeline as a list of launches, recorded once per structure and repeated at every plan.

On the CPU each launch runs on one thread but releases the interpreter, so the heavy stages are cut into chunks, slices
of the points and of the instances, which threads take up one after another. On CUDA there is one chunk to a stage, and
everything replays as one graph.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import warp as wp

from aero_planner import anchors, clearance, guides, mppi, partition, stage2
from aero_planner.buffers import as_vectors, fine_shape, list_capacity, padded_samples, sample_width
from aero_planner.config import PlannerConfig

__all__ = ["Pipeline"]


Chunk = list[tuple[str, Callable[[], Any]]]
"""Launches in order, each with the name under which its time is counted."""


class Pipeline:
    """Runs the kernels over the given arrays.

    Args:
        config: structure of the planner.
        batch: B.
        lanes: number of threads, 1 on CUDA.
        inputs, outputs, work: arrays of `buffers`.
        points: cloud, shape [B, P], world frame.
        params: live parameters, shape [B].
    """

    def __init__(
        self,
        config: PlannerConfig,
        *,
        batch: int,
        lanes: int,
        inputs: SimpleNamespace,
        outputs: SimpleNamespace,
        work: SimpleNamespace,
        points: wp.array,
        params: wp.array,
    ) -> None:
        self._device: wp.Device = wp.get_device(str(points.device))
        self._lanes = lanes
        self._points = points
        self._batch = batch
        self._executor = ThreadPoolExecutor(lanes - 1, "aero-planner") if lanes > 1 else None
        self._width = 64 if self._device.is_cpu else 1
        self._graph: Any = None
        self._scatter: list[Any] = []
        self.stage_ms: dict[str, float] = {}
        self._resets = [work.list.end, work.total, outputs.dropped]
        self._stages = self._record(config, inputs, outputs, work, params)

    def _record(
        self,
        config: PlannerConfig,
        inputs: SimpleNamespace,
        outputs: SimpleNamespace,
        work: SimpleNamespace,
        params: wp.array,
    ) -> list[list[Chunk]]:
        B, M, N, K = self._batch, len(config.kinds), config.sampling.steps, config.sampling.samples
        part, anchor_count = config.partition, config.anchor_count
        rows, columns = fine_shape(config)
        fine, coarse, instances = rows * columns, part.coarse_rows * part.coarse_columns, B * M
        previous = config.kinds.index("previous") if "previous" in config.kinds else -1
        brake = config.kinds.index("brake") if "brake" in config.kinds else -1
        i, o, w = inputs, outputs, work
        state = [i.position, i.velocity, w.quaternion]
        goal = [i.goal_position, w.goal_velocity, w.goal_quaternion]
        pool = [part.fine_cells, part.coarse_rows, part.coarse_columns]

        def launch(kernel: Any, dim: Any, *arguments: Any) -> Any:
            return wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._device, record_cmd=True)

        def serial(name: str, *launches: Any) -> list[Chunk]:
            return [[(name, command.launch) for command in launches]]

        directions = serial(
            "anchors",
            launch(
                anchors.prepare, B, i.position, i.quaternion, i.goal_position, i.goal_velocity, i.goal_quaternion,
                w.quaternion, w.goal_velocity, w.goal_quaternion,
            ),
            launch(
                anchors.place_anchors, (B, anchor_count), *state, i.goal_position, params, config.anchors.columns,
                config.anchors.rows, N, w.reach, w.initial_direction, o.initial_endpoint,
            ),
        )  # fmt: skip
        scatter: list[Chunk] = []
        share = -(-self._points.shape[1] // (self._width * self._lanes))
        for lane in range(self._lanes):
            command = launch(
                partition.scatter_points(self._width), (B, share), lane * share * self._width, lane, self._points, i.point_count, i.position,
                w.quaternion, params, rows, columns, w.keys, o.dropped,
            )  # fmt: skip
            scatter.append([("partition", command.launch)])
            self._scatter.append(command)
        coarse_cells = serial(
            "partition",
            launch(
                partition.finish_fine, (B, fine), w.keys, self._points, params, o.fine_range, o.occupied, o.filtered,
            ),
            launch(
                partition.pool_coarse, (B, coarse), o.fine_range, w.initial_direction, anchor_count, *pool,
                o.safe_range, o.safe_direction,
            ),
        )  # fmt: skip
        guide = serial(
            "guides",
            launch(
                anchors.refine_anchors, (B, anchor_count), i.position, w.quaternion, params, o.fine_range, w.reach,
                w.initial_direction, *pool, o.anchor,
            ),
            launch(
                guides.make_guides, (B, M), *state, i.acceleration, i.time, *goal, params, anchor_count, previous,
                brake, w.reach, w.previous_controls, w.previous_end, w.previous_time, o.initial_endpoint, o.anchor,
                o.coefficient, o.guide, w.nominal,
            ),
        )  # fmt: skip
        capacity = list_capacity(config, self._lanes, self._device)
        index: list[Chunk] = []
        for lane in range(self._lanes):
            rows_of_lane = len(range(lane, clearance.GRID, self._lanes)) * clearance.GRID
            launches = [
                launch(
                    clearance.count_points, (B, fine), lane, self._lanes, o.occupied, o.filtered, i.position, params,
                    w.list,
                ),
                launch(
                    clearance.allocate_rows, (B, rows_of_lane), lane, self._lanes, capacity, w.list, w.total,
                ),
                launch(
                    clearance.fill_rows, (B, fine), lane, self._lanes, capacity, o.occupied, o.filtered, i.position,
                    params, w.total, w.list, w.coordinates,
                ),
            ]  # fmt: skip
            index.append([("grid", command.launch) for command in launches])
        optimise: list[Chunk] = []
        stride, width = 1 if self._device.is_cpu else K, sample_width(self._device)
        groups = padded_samples(config, self._device) // width
        # More chunks than threads, since instances amid obstacles take longer than those in the open.
        chunks = min(instances, 4 * self._lanes) if self._lanes > 1 else 1
        for chunk in range(chunks):
            first = instances * chunk // chunks
            n = instances * (chunk + 1) // chunks - first
            launches = [
                ("rollouts", launch(
                    mppi.sample_rollouts(width), (n, groups), first, M, previous, *state, *goal, params, w.seed, w.tick,
                    as_vectors(w.noise, width), o.guide, w.nominal, as_vectors(w.sample_controls, width),
                    as_vectors(w.sample_positions, width), as_vectors(o.cost, width),
                )),
                ("clearance", launch(
                    clearance.query_clearance, (n, N + mppi.PROBES, stride), first, M, N, stride, w.sample_positions,
                    i.position, params, w.list, w.sample_distance,
                )),
                ("update", launch(
                    mppi.score_samples, (n, K), first, M, i.goal_position, params, w.sample_positions,
                    w.sample_distance, o.cost,
                )),
                ("update", launch(mppi.weigh, n, first, M, params, o.cost, w.weight)),
                ("update", launch(mppi.update, (n, N), first, M, w.nominal, w.sample_controls, w.weight, o.controls)),
                ("stage2", launch(
                    stage2.roll_out_best, n, first, M, *state, *goal, params, o.controls, o.positions, o.velocities,
                    o.quaternions, w.probed, o.J_goal, w.J_speed,
                )),
                ("stage2", launch(
                    clearance.query_clearance, (n, N + mppi.PROBES, 1), first, M, N, 1, w.probed, i.position,
                    params, w.list, w.distance,
                )),
            ]  # fmt: skip
            optimise.append([(name, command.launch) for name, command in launches])
        choose = serial(
            "stage2",
            launch(
                stage2.select, B, i.goal_position, i.position, params, i.cloud_age, w.list, w.distance, o.positions,
                o.J_goal, w.J_speed, o.J_col, o.S2, o.clearance, o.best, o.status,
            ),
            launch(
                stage2.brake_where_unsafe, B, brake, *state, i.acceleration, *goal, params, w.list, o.status, o.best,
                o.braked, o.anchor, o.coefficient, o.guide, o.controls, o.positions, o.velocities, o.quaternions,
                w.probed, w.distance, o.J_goal, w.J_speed, o.J_col, o.S2, o.clearance,
            ),
            launch(
                stage2.remember, B, i.time, params, o.best, o.controls, o.positions, w.tick, w.previous_controls,
                w.previous_end, w.previous_time,
            ),
        )  # fmt: skip
        return [directions, scatter, coarse_cells, guide, index, optimise, choose]

    def limit_points(self, count: int) -> None:
        """Let the partition read only the first `count` points of each drone, where launches are not captured."""
        if self._device.is_cpu:
            groups = -(-count // self._width)
            share = -(-groups // self._lanes)
            for lane, command in enumerate(self._scatter):
                command.set_param_at_index(0, lane * share * self._width)
                command.set_dim((self._batch, max(0, min(share, groups - lane * share))))

    def run(self) -> None:
        """Run all stages in order. `stage_ms` then holds the time of each on the CPU, [ms]."""
        if self._device.is_cuda:
            if self._graph is None:
                # Modules must be loaded before a capture.
                self._run_eagerly()
                return self._capture()
            wp.capture_launch(self._graph)
        else:
            self._run_eagerly()

    def _capture(self) -> None:
        with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
            self._run_eagerly()
        self._graph = capture.graph

    def _run_eagerly(self) -> None:
        for array in self._resets:
            array.zero_()
        self.stage_ms = {}
        for stage in self._stages:
            chunks = deque(stage)
            helpers = min(len(chunks), self._lanes) - 1
            others = (
                [self._executor.submit(self._run_chunks, chunks, {}) for _ in range(helpers)] if self._executor else []
            )
            self._run_chunks(chunks, self.stage_ms)
            started = time.perf_counter()
            for other in others:
                other.result()
            if others:
                last = stage[0][-1][0]
                self.stage_ms[last] = self.stage_ms.get(last, 0.0) + 1e3 * (time.perf_counter() - started)

    @staticmethod
    def _run_chunks(chunks: deque[Chunk], stage_ms: dict[str, float]) -> None:
        """Run chunks until none is left; called by several threads at once."""
        while chunks:
            try:
                chunk = chunks.popleft()
            except IndexError:  # another thread was faster
                return
            for name, launch in chunk:
                started = time.perf_counter()
                launch()
                stage_ms[name] = stage_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - started)

    def close(self) -> None:
        """End the worker threads."""
        if self._executor:
            self._executor.shutdown(wait=True)
