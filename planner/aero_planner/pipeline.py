"""The stages of a plan, recorded once per structure as kernel launches and replayed for every plan.

On the CPU a launch runs on one thread but releases the interpreter. The heavy stages are therefore split into chunks,
slices of the points or of the instances, which a pool of worker threads processes. On CUDA every stage is one chunk,
and all launches replay as one graph with a side stream for independent stages.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import warp as wp

from aero_planner.array_memory import as_scalars, as_vectors
from aero_planner.arrays import PlannerInputs, PlannerOutputs, Sizes, Workspace
from aero_planner.config import PlannerConfig
from aero_planner.kernels import anchors, clearance, guides, mppi, partition, selection
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.records import (
    DroneState,
    GoalState,
    GuideSet,
    InstanceCosts,
    PreviousPlan,
    Rollouts,
    bundle,
)

__all__ = ["Pipeline", "tuned_kernels"]

Launch = tuple[str, Callable[[], Any]]
"""A launch, and the name of the stage under which its time is counted."""
Chunk = list[Launch]
"""Launches that run one after another."""


def tuned_kernels(tuning: KernelTuning) -> list[tuple[wp.Kernel, int]]:
    """Return every kernel made for a tuning, for one drone and for many, and the block size of its launches."""
    many = tuning.for_batch(1024)
    return [
        (partition.scatter_points(tuning), 256),
        (guides.make_guides(tuning), 32),
        (mppi.sample_rollouts(tuning), 32),
        (clearance.query_clearance(tuning), 128),
        (clearance.query_clearance(many), 128),
        (mppi.update_controls(tuning), tuning.threads_per_update),
        (mppi.update_controls(many), many.threads_per_update),
        (selection.roll_out_controls(tuning), 32),
        (selection.evaluate_states(tuning), 32),
        (selection.evaluate_states(many), 32),
        (selection.score_instances(tuning), 32),
    ]


class Pipeline:
    """Runs the kernels over the planner's arrays.

    Args:
        config: configuration, of which only the structure is used.
        sizes: sizes of the arrays.
        tuning: tuning of the device for one drone.
        inputs, outputs, work: arrays of the planner.
        points: cloud, shape [B, P], vec3 [m], world frame.
        params: live parameters, shape [B].
    """

    def __init__(
        self,
        config: PlannerConfig,
        sizes: Sizes,
        tuning: KernelTuning,
        *,
        inputs: PlannerInputs,
        outputs: PlannerOutputs,
        work: Workspace,
        points: wp.array,
        params: wp.array,
    ) -> None:
        self._device: wp.Device = wp.get_device(str(points.device))
        self._config, self._sizes = config, sizes
        self._tuning, self._batch_tuning = tuning, tuning.for_batch(sizes.B)
        self._inputs, self._outputs, self._work = inputs, outputs, work
        self._points, self._params = points, params
        kinds = config.kinds
        self._previous_index = kinds.index("previous") if "previous" in kinds else -1
        self._brake_index = kinds.index("brake") if "brake" in kinds else -1
        self._duplicate_rows = 0 if tuning.is_cuda else 1
        i, o, w = inputs, outputs, work
        self._drone = bundle(
            DroneState,
            position=i.position,
            velocity=i.velocity,
            quaternion=w.quaternion,
            acceleration=i.acceleration,
        )
        self._goal = bundle(GoalState, position=i.goal_position, velocity=w.goal_velocity, quaternion=w.goal_quaternion)
        self._guides = bundle(
            GuideSet,
            initial_endpoints=o.initial_endpoints,
            anchors=o.anchors,
            coefficients=o.guide_coefficients,
            positions=o.guides,
        )
        self._rollouts = bundle(
            Rollouts,
            controls=o.controls,
            positions=o.positions,
            velocities=o.velocities,
            quaternions=o.quaternions,
        )
        self._costs = bundle(
            InstanceCosts, goal_cost=o.goal_cost, collision_cost=o.collision_cost, stage2_cost=o.stage2_cost
        )
        self._previous = bundle(
            PreviousPlan,
            controls=w.previous_controls,
            end=w.previous_end,
            waypoint=w.previous_waypoint,
            time=w.previous_time,
        )
        workers = sizes.W
        self._executor = ThreadPoolExecutor(workers - 1, "aero-planner") if workers > 1 else None
        self._side_stream: Any = wp.Stream(self._device) if tuning.is_cuda else None
        self._graph: Any = None
        self._scatter_launches: list[Any] = []
        self.stage_ms: dict[str, float] = {}
        self._stages = self._record()

    # --- the stages, in the order of docs/design.md ------------------------------------------------------------------

    def _record(self) -> list[list[Chunk]]:
        """Record all launches. Fork and join only matter on CUDA, where a side branch runs beside what follows it."""
        return [
            self._side_branch("anchors", *self._place_anchors()),  # beside the scan of the cloud
            self._scan_points(),
            self._serial("partition", self._finish_fine_cells(), self._join),
            self._serial("grid", self._fork),  # until the first clearance query
            self._build_clearance_grid(),
            self._serial("guides", self._end_fork, self._make_guides()),
            self._optimize(),
            self._side_branch("partition", self._pool_coarse_cells()),  # only shown: no later stage needs it
            self._serial("stage2", *self._evaluate_instances(), self._commit_plan(), self._join),
        ]

    def _place_anchors(self) -> list[Callable[[], Any]]:
        i, o, w, anchor_config = self._inputs, self._outputs, self._work, self._config.anchors
        drone = bundle(
            DroneState,
            position=i.position,
            velocity=i.velocity,
            quaternion=i.quaternion,
            acceleration=i.acceleration,
        )
        goal = bundle(GoalState, position=i.goal_position, velocity=i.goal_velocity, quaternion=i.goal_quaternion)
        place = self._launch(
            anchors.place_anchors,
            (self._sizes.B, self._sizes.A),
            inputs=[drone, goal, self._params, anchor_config.columns, anchor_config.rows, self._sizes.N],
            outputs=[w.quaternion, self._goal, w.lookahead_length, w.initial_directions, o.initial_endpoints],
        )
        return [w.cell_ends.zero_, w.points_used.zero_, place]

    def _scan_points(self) -> list[Chunk]:
        """Find the nearest point of each fine cell; every worker scans a slice of the cloud."""
        i, w, per_thread = self._inputs, self._work, self._tuning.points_per_thread
        share = -(-self._points.shape[1] // (per_thread * self._sizes.W))
        chunks: list[Chunk] = []
        for worker in range(self._sizes.W):
            command: Any = wp.launch(
                partition.scatter_points(self._tuning),
                (self._sizes.B, share),
                inputs=[
                    worker * share * per_thread, worker, self._points, i.point_count, i.position, i.quaternion,
                    self._params, self._sizes.F0, self._sizes.F1,
                ],
                outputs=[w.cell_keys, w.worker_dropped],
                device=self._device,
                record_cmd=True,
            )  # fmt: skip
            self._scatter_launches.append(command)
            chunks.append([("partition", command.launch)])
        return chunks

    def _finish_fine_cells(self) -> Callable[[], Any]:
        o, w = self._outputs, self._work
        return self._launch(
            partition.finish_fine_cells,
            (self._sizes.B, self._sizes.F),
            inputs=[self._points, self._params, w.cell_keys, w.worker_dropped],
            outputs=[o.fine_range, o.occupied, o.filtered_points, o.dropped_points],
        )

    def _build_clearance_grid(self) -> list[Chunk]:
        """Sort the filtered cloud into the grid; every worker sorts the layers that are its own."""
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        workers, capacity = sizes.W, sizes.worker_capacity
        chunks: list[Chunk] = []
        for worker in range(workers):
            worker_rows = len(range(worker, clearance.GRID, workers)) * clearance.GRID
            count = self._launch(
                clearance.count_points,
                (sizes.B, sizes.F),
                inputs=[worker, workers, i.position, self._params, self._duplicate_rows, o.occupied, o.filtered_points],
                outputs=[w.cell_ends],
            )
            allocate = self._launch(
                clearance.allocate_rows,
                (sizes.B, -(-worker_rows // 32) * 32),
                inputs=[worker, workers, worker_rows, capacity],
                outputs=[w.points_used, w.cell_counts],
                block_dim=32,
            )
            fill = self._launch(
                clearance.fill_rows,
                (sizes.B, sizes.F),
                inputs=[
                    worker, workers, capacity, i.position, self._params, self._duplicate_rows, o.occupied,
                    o.filtered_points, w.points_used,
                ],
                outputs=[w.cell_ends, w.pack_coordinates],
            )  # fmt: skip
            chunks += self._serial("grid", count, allocate, fill)
        return chunks

    def _make_guides(self) -> Callable[[], Any]:
        i, o, w, sizes, part = self._inputs, self._outputs, self._work, self._sizes, self._config.partition
        return self._launch(
            guides.make_guides(self._tuning),
            (sizes.B, sizes.R, self._tuning.threads_per_instance),
            inputs=[
                self._drone, i.time, self._goal, self._params, sizes.M, sizes.A, self._previous_index,
                part.fine_cells, part.coarse_rows, part.coarse_columns, o.fine_range, w.fine_directions,
                w.lookahead_length, w.initial_directions, self._previous,
            ],
            outputs=[self._guides, w.waypoints, w.nominal_controls],
            block_dim=32,
        )  # fmt: skip

    def _optimize(self) -> list[Chunk]:
        """Stage I: sample, query the clearance and update the controls, for a slice of the instances per chunk."""
        instances = self._sizes.B * self._sizes.M
        # More chunks than workers, since instances among obstacles take longer than those in the open.
        count = min(instances, 4 * self._sizes.W) if self._sizes.W > 1 else 1
        bounds = [instances * chunk // count for chunk in range(count + 1)]
        return [
            [
                ("rollouts", self._sample_rollouts(first, end - first)),
                ("clearance", self._join),
                ("clearance", self._query_clearance(first, end - first)),
                ("update", self._update_controls(first, end - first)),
            ]
            for first, end in itertools.pairwise(bounds)
        ]

    def _sample_rollouts(self, first: int, count: int) -> Callable[[], Any]:
        o, w, sizes, width = self._outputs, self._work, self._sizes, self._tuning.samples_per_thread
        return self._launch(
            mppi.sample_rollouts(self._tuning),
            (count, sizes.L // width),
            inputs=[
                first, sizes.M, self._previous_index, self._drone, self._goal, self._params, w.seed, w.tick,
                as_vectors(w.noise, width), o.guides, w.waypoints, w.nominal_controls,
            ],
            outputs=[
                as_vectors(w.sample_controls, width), as_vectors(w.sample_positions, width),
                as_vectors(o.stage1_cost, width),
            ],
            block_dim=32,
        )  # fmt: skip

    def _query_clearance(self, first: int, count: int) -> Callable[[], Any]:
        i, w, sizes = self._inputs, self._work, self._sizes
        stride = sizes.K if self._tuning.is_cuda else 1
        return self._launch(
            clearance.query_clearance(self._batch_tuning),
            (count, sizes.Q, stride * self._batch_tuning.threads_per_sample_query),
            inputs=[
                first, sizes.M, sizes.N, stride, i.position, i.ground_height, self._params, self._duplicate_rows,
                w.cell_ends, w.point_packs, w.sample_positions,
            ],
            outputs=[w.sample_clearance_cost],
            block_dim=128,
        )  # fmt: skip

    def _update_controls(self, first: int, count: int) -> Callable[[], Any]:
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        threads, width = self._batch_tuning.threads_per_update, self._tuning.samples_per_read
        sample_controls = as_vectors(w.sample_controls, width).reshape((sizes.B * sizes.M, sizes.N * 4, -1))
        return self._launch(
            mppi.update_controls(self._batch_tuning),
            (count, threads),
            inputs=[
                first, sizes.M, i.goal_position, self._params, w.waypoints, as_scalars(w.nominal_controls),
                sample_controls, w.sample_positions, w.sample_clearance_cost,
            ],
            outputs=[o.stage1_cost, w.sample_weights, as_vectors(w.sample_weights, width), as_scalars(o.controls)],
            block_dim=threads,
        )  # fmt: skip

    def _pool_coarse_cells(self) -> Callable[[], Any]:
        o, w, part = self._outputs, self._work, self._config.partition
        return self._launch(
            partition.pool_coarse,
            (self._sizes.B, self._sizes.C),
            inputs=[
                part.fine_cells, part.coarse_rows, part.coarse_columns, o.fine_range, w.fine_directions,
                w.initial_directions,
            ],
            outputs=[o.safe_range, o.safe_direction],
            block_dim=32,
        )  # fmt: skip

    def _evaluate_instances(self) -> list[Callable[[], Any]]:
        """Stage II: roll out the optimised controls and sum S2."""
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        lanes, threads = self._tuning.threads_per_instance, self._batch_tuning.threads_per_query
        roll_out = self._launch(
            selection.roll_out_controls(self._tuning),
            (sizes.B, sizes.R, lanes),
            inputs=[self._drone, self._params, sizes.M, w.nominal_controls],
            outputs=[self._rollouts],
            block_dim=32,
        )
        evaluate = self._launch(
            selection.evaluate_states(self._batch_tuning),
            (sizes.B, sizes.R, sizes.Q + sizes.N + 1, threads),
            inputs=[
                self._drone, i.ground_height, self._goal, self._params, self._duplicate_rows, w.cell_ends,
                w.point_packs, w.waypoints, self._rollouts,
            ],
            outputs=[o.clearance, w.state_terms],
            block_dim=32,
        )  # fmt: skip
        score = self._launch(
            selection.score_instances(self._tuning),
            (sizes.B, sizes.R, lanes),
            inputs=[i.goal_position, self._params, w.waypoints, o.positions, w.state_terms],
            outputs=[self._costs, w.instance_scores],
            block_dim=32,
        )
        return [roll_out, evaluate, score]

    def _commit_plan(self) -> Callable[[], Any]:
        i, o, w, sizes = self._inputs, self._outputs, self._work, self._sizes
        return self._launch(
            selection.commit_plan,
            (sizes.B, sizes.N + 1),
            inputs=[
                i.time, i.goal_position, i.cloud_age, self._params, sizes.M, self._brake_index, w.waypoints,
                w.state_terms, w.instance_scores,
            ],
            outputs=[
                self._guides, self._rollouts, self._costs, o.clearance, w.tick, o.best, o.status,
                o.braking_instance, self._previous,
            ],
            block_dim=32,
        )  # fmt: skip

    # --- recording ---------------------------------------------------------------------------------------------------

    def _launch(
        self, kernel: Any, dim: tuple[int, ...], *, inputs: list[Any], outputs: list[Any], block_dim: int = 256
    ) -> Callable[[], Any]:
        """Record a launch and return the function that runs it."""
        command: Any = wp.launch(
            kernel, dim, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True, block_dim=block_dim
        )
        return command.launch

    @staticmethod
    def _serial(name: str, *launches: Callable[[], Any]) -> list[Chunk]:
        """Return a stage of one chunk."""
        return [[(name, launch) for launch in launches]]

    def _side_branch(self, name: str, *launches: Callable[[], Any]) -> list[Chunk]:
        """Return a stage that runs on the side stream, beside the stages up to the next join."""
        return self._serial(name, self._fork, *launches, self._end_fork)

    def _fork(self) -> None:
        """On CUDA, put the following launches on the side stream, after everything so far."""
        if self._side_stream is not None:
            self._side_stream.wait_event(self._main_stream.record_event())
            self._device.set_stream(self._side_stream, sync=False)

    def _end_fork(self) -> None:
        """On CUDA, put the following launches on the main stream again, beside those since `_fork`."""
        if self._side_stream is not None:
            self._fork_end = self._side_stream.record_event()
            self._device.set_stream(self._main_stream, sync=False)

    def _join(self) -> None:
        """On CUDA, let the main stream wait for the launches between `_fork` and `_end_fork`."""
        if self._side_stream is not None:
            self._main_stream.wait_event(self._fork_end)

    def limit_points(self, count: int) -> None:
        """Scan only the first `count` points of each drone; on CUDA a captured launch always covers all points."""
        if self._device.is_cpu:
            per_thread, workers = self._tuning.points_per_thread, self._sizes.W
            groups = -(-count // per_thread)
            share = -(-groups // workers)
            for worker, command in enumerate(self._scatter_launches):
                command.set_param_at_index(0, worker * share * per_thread)
                command.set_dim((self._sizes.B, max(0, min(share, groups - worker * share))))

    # --- replay ------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Run all stages in order. On the CPU, `stage_ms` then holds the time of each stage [ms]."""
        if self._device.is_cpu:
            self._run_eagerly()
        elif self._graph is None:
            self._run_eagerly()  # loads the modules, which a capture cannot do
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                self._run_eagerly()
            self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)

    def time_stages(self, repeat: int) -> dict[str, list[float]]:
        """Return the time of each stage in `repeat` plans on CUDA [ms].

        The stages run one after another here, with an event after each; in `run` some of them run at the same time.
        """
        device = self._device
        events: list[tuple[str, wp.Event]] = []

        def record_event(name: str) -> None:
            event = wp.Event(device, enable_timing=True)
            device.stream.record_event(event, external=True)
            events.append((name, event))

        with self._single_stream(), wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            record_event("")
            launches = [launch for stage in self._stages for chunk in stage for launch in chunk]
            for i, (name, launch) in enumerate(launches):
                launch()
                if i + 1 == len(launches) or launches[i + 1][0] != name:
                    record_event(name)
        graph: Any = capture.graph
        times: dict[str, list[float]] = {name: [0.0] * repeat for name, _ in events[1:]}
        for i in range(repeat):
            wp.capture_launch(graph)
            wp.synchronize_device(device)
            for (_, begin), (name, end) in itertools.pairwise(events):
                times[name][i] += wp.get_event_elapsed_time(begin, end)
        return times

    def capture_graph(self) -> Any:
        """Return the launches as a graph for `wp.capture_save`, in sequence; they must have run once before.

        On the CPU there must be one worker.
        """
        with self._single_stream(), wp.ScopedCapture(device=self._device, apic=True) as capture:
            self._run_eagerly()
        return capture.graph

    @contextmanager
    def _single_stream(self) -> Iterator[None]:
        """On CUDA, run everything on one stream."""
        side_stream, self._side_stream = self._side_stream, None
        try:
            yield
        finally:
            self._side_stream = side_stream

    def _run_eagerly(self) -> None:
        if self._side_stream is not None:
            self._main_stream = self._device.stream
        self.stage_ms = {}
        for stage in self._stages:
            chunks = deque(stage)
            helpers = min(len(chunks), self._sizes.W) - 1
            futures = (
                [self._executor.submit(self._run_chunks, chunks, {}) for _ in range(helpers)] if self._executor else []
            )
            self._run_chunks(chunks, self.stage_ms)
            started = time.perf_counter()
            for future in futures:
                future.result()
            if futures:
                last = stage[0][-1][0]
                self.stage_ms[last] = self.stage_ms.get(last, 0.0) + 1e3 * (time.perf_counter() - started)

    @staticmethod
    def _run_chunks(chunks: deque[Chunk], stage_ms: dict[str, float]) -> None:
        """Run chunks until none is left; several threads call this at once."""
        while chunks:
            try:
                chunk = chunks.popleft()
            except IndexError:  # another thread took the last one
                return
            for name, launch in chunk:
                started = time.perf_counter()
                launch()
                stage_ms[name] = stage_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - started)

    def close(self) -> None:
        """Stop the worker threads, without waiting for one that hangs."""
        if self._executor:
            self._executor.shutdown(wait=False, cancel_futures=True)
