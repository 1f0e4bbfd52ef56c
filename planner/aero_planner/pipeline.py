"""The pipeline as a list of launches, recorded once per structure and repeated at every plan.

On the CPU each launch runs on one thread but releases the interpreter, so the heavy stages are cut into chunks, slices
of the points and of the instances, which threads take up one after another. On CUDA there is one chunk to a stage, and
everything replays as one graph.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import warp as wp

from aero_planner.arrays import (
    as_values,
    as_vectors,
    fine_shape,
    list_capacity,
    padded_samples,
)
from aero_planner.config import PlannerConfig
from aero_planner.kernels import anchors, clearance, guides, mppi, partition, selection
from aero_planner.kernels.kernel_tuning import Widths, widths

__all__ = ["Pipeline", "made_kernels"]


_FEW = 2
"""Drones that leave a GPU threads to spare."""

Chunk = list[tuple[str, Callable[[], Any]]]
"""Launches in order, each with the name under which its time is counted."""


def made_kernels(of: Widths) -> list[tuple[wp.Kernel, int]]:
    """Return the kernels made for the widths `of` a device, and the size of the blocks that they are launched in."""
    crowd = of.crowded()
    return [
        (partition.scatter_points(of), 256),
        (guides.make_guides(of), 32),
        (mppi.sample_rollouts(of), 32),
        (clearance.query_clearance(of), 128),
        (clearance.query_clearance(crowd), 128),
        (mppi.improve(of), of.improve),
        (mppi.improve(crowd), crowd.improve),
        (selection.roll_out_best(of), 32),
        (selection.evaluate(of), 32),
        (selection.evaluate(crowd), 32),
        (selection.score(of), 32),
    ]


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
        self._widths = widths(self._device)
        self._side: Any = None if self._device.is_cpu else wp.Stream(self._device)
        self._graph: Any = None
        self._scatter: list[Any] = []
        self.stage_ms: dict[str, float] = {}
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
        rolled_out = M + guides.BRAKES
        of, beside = self._widths, 1 if self._device.is_cpu else 0
        some = of.crowded() if B > _FEW else of
        cloud = [beside, w.end, w.blocks]

        def launch(kernel: Any, dim: Any, *arguments: Any, block_dim: int = 256) -> Callable[[], Any]:
            command: Any = wp.launch(
                kernel, dim=dim, inputs=list(arguments), device=self._device, record_cmd=True, block_dim=block_dim
            )
            return command.launch

        def serial(name: str, *launches: Callable[[], Any]) -> list[Chunk]:
            return [[(name, one) for one in launches]]

        # On CUDA what does not need the cloud runs beside the first look at it.
        directions = serial(
            "anchors",
            self._fork,
            w.end.zero_,
            w.total.zero_,
            launch(
                anchors.place_anchors, (B, anchor_count), i.position, i.velocity, i.quaternion, i.goal_position,
                i.goal_velocity, i.goal_quaternion, params, config.anchors.columns, config.anchors.rows, N,
                w.quaternion, w.goal_velocity, w.goal_quaternion, w.reach, w.initial_direction, o.initial_endpoint,
            ),
            self._return,
        )  # fmt: skip
        scatter: list[Chunk] = []
        share = -(-self._points.shape[1] // (of.cloud * self._lanes))
        for lane in range(self._lanes):
            command: Any = wp.launch(
                partition.scatter_points(of), (B, share), device=self._device, record_cmd=True, inputs=[
                    lane * share * of.cloud, lane, self._points, i.point_count, i.position, i.quaternion,
                    params, rows, columns, w.keys, w.dropped,
                ],
            )  # fmt: skip
            scatter.append([("partition", command.launch)])
            self._scatter.append(command)
        fine_cells = serial(
            "partition",
            launch(
                partition.finish_fine, (B, fine), w.keys, w.dropped, self._points, params, o.fine_range, o.occupied,
                o.filtered, o.dropped,
            ),
            self._join,
        )  # fmt: skip
        # From here to the first look at the clearance, CUDA works on the grid and on the rollouts at the same time.
        fork = serial("grid", self._fork)
        capacity = list_capacity(config, self._lanes, self._device)
        index: list[Chunk] = []
        for lane in range(self._lanes):
            rows_of_lane = len(range(lane, clearance.GRID, self._lanes)) * clearance.GRID
            index += serial(
                "grid",
                launch(
                    clearance.count_points, (B, fine), lane, self._lanes, o.occupied, o.filtered, i.position, params,
                    beside, w.end,
                ),
                launch(
                    clearance.allocate_rows, (B, -(-rows_of_lane // 32) * 32), lane, self._lanes, rows_of_lane,
                    capacity, w.total, w.counts, block_dim=32,
                ),
                launch(
                    clearance.fill_rows, (B, fine), lane, self._lanes, capacity, o.occupied, o.filtered, i.position,
                    params, w.total, beside, w.end, w.coordinates,
                ),
            )  # fmt: skip
        guide = serial(
            "guides",
            self._return,
            launch(
                guides.make_guides(of), (B, rolled_out, of.steps), *state, i.acceleration, i.time, *goal, params, M,
                anchor_count, previous, o.fine_range, w.directions, w.initial_direction, part.fine_cells,
                part.coarse_rows, part.coarse_columns, w.reach, w.previous_controls, w.previous_end, w.previous_turn,
                w.previous_time, o.initial_endpoint, o.anchor, o.coefficient, o.guide, w.turn, w.nominal, block_dim=32,
            ),
        )  # fmt: skip
        optimise: list[Chunk] = []
        # More chunks than threads, since instances amid obstacles take longer than those in the open.
        chunks = min(instances, 4 * self._lanes) if self._lanes > 1 else 1
        stride = 1 if self._device.is_cpu else K
        sample_controls = as_vectors(w.sample_controls, of.sums).reshape((B * M, N * 4, -1))
        groups = padded_samples(config, self._device) // of.samples
        for chunk in range(chunks):
            first = instances * chunk // chunks
            n = instances * (chunk + 1) // chunks - first
            optimise.append([
                ("rollouts", launch(
                    mppi.sample_rollouts(of), (n, groups), first, M, previous, *state, *goal, params, w.seed,
                    w.tick, as_vectors(w.noise, of.samples), o.guide, w.turn, w.nominal,
                    as_vectors(w.sample_controls, of.samples), as_vectors(w.sample_positions, of.samples),
                    as_vectors(o.cost, of.samples), block_dim=32,
                )),
                ("clearance", self._join),
                ("clearance", launch(
                    clearance.query_clearance(some), (n, N + mppi.PROBES, stride * some.query), first, M, N, stride,
                    w.sample_positions, i.position, i.ground_height, params, *cloud, w.sample_clearance_cost,
                    block_dim=128,
                )),
                ("update", launch(
                    mppi.improve(some), (n, some.improve), first, M, i.goal_position, w.turn, params,
                    as_values(w.nominal), sample_controls, w.sample_positions, w.sample_clearance_cost, o.cost,
                    w.weight, as_vectors(w.weight, of.sums), as_values(o.controls), block_dim=some.improve,
                )),
            ])  # fmt: skip
        # Nothing waits for the coarse cells, which are shown only: CUDA pools them beside Stage II.
        coarse_cells = serial(
            "partition",
            self._fork,
            launch(
                partition.pool_coarse, (B, coarse), o.fine_range, w.directions, w.initial_direction, anchor_count,
                part.fine_cells, part.coarse_rows, part.coarse_columns, o.safe_range, o.safe_direction,
                block_dim=32,
            ),
            self._return,
        )  # fmt: skip
        choose = serial(
            "stage2",
            launch(
                selection.roll_out_best(of), (B, rolled_out, of.steps), M, *state, params, w.nominal, o.controls,
                o.positions, o.velocities, o.quaternions, block_dim=32,
            ),
            launch(
                selection.evaluate(some), (B, rolled_out, 2 * N + mppi.PROBES + 1, some.team), i.position,
                i.ground_height, *goal,
                w.turn, params, *cloud, o.positions, o.velocities, o.quaternions, o.clearance, w.terms, block_dim=32,
            ),
            launch(
                selection.score(of), (B, rolled_out, of.steps), i.goal_position, w.turn, params, o.positions, w.terms,
                o.J_goal, o.J_col, o.S2, w.scores, block_dim=32,
            ),
            launch(
                selection.conclude, (B, N + 1), M, brake, i.time, params, i.cloud_age, i.goal_position, w.turn, w.terms,
                w.scores, o.anchor, o.coefficient, o.guide, o.controls, o.positions, o.velocities, o.quaternions,
                o.J_goal, o.J_col, o.S2, o.clearance, o.best, o.status, o.braked, w.tick, w.previous_controls,
                w.previous_end, w.previous_turn, w.previous_time,
                block_dim=32,
            ),
            self._join,
        )  # fmt: skip
        return [directions, scatter, fine_cells, fork, index, guide, optimise, coarse_cells, choose]

    def _fork(self) -> None:
        """On CUDA, let the following launches run on a stream of their own."""
        if self._side is not None:
            self._side.wait_event(self._main.record_event())
            self._device.set_stream(self._side, sync=False)

    def _return(self) -> None:
        """On CUDA, go on where `_fork` left, beside what was launched since."""
        if self._side is not None:
            self._side_done = self._side.record_event()
            self._device.set_stream(self._main, sync=False)

    def _join(self) -> None:
        """On CUDA, wait for what was launched between `_fork` and `_return`."""
        if self._side is not None:
            self._main.wait_event(self._side_done)

    def limit_points(self, count: int) -> None:
        """Let the partition read only the first `count` points of each drone, where launches are not captured."""
        if self._device.is_cpu:
            groups = -(-count // self._widths.cloud)
            share = -(-groups // self._lanes)
            for lane, command in enumerate(self._scatter):
                command.set_param_at_index(0, lane * share * self._widths.cloud)
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

    def time_stages(self, repeat: int) -> dict[str, list[float]]:
        """Return the times of each stage in `repeat` plans on CUDA [ms].

        They run one after another, with an event between them; in `run` some run side by side.
        """
        device = self._device
        marks: list[tuple[str, wp.Event]] = []

        def mark(name: str) -> None:
            event = wp.Event(device, enable_timing=True)
            device.stream.record_event(event, external=True)
            marks.append((name, event))

        with self._one_stream(), wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            mark("")
            launches = [one for stage in self._stages for chunk in stage for one in chunk]
            for i, (name, launch) in enumerate(launches):
                launch()
                if i + 1 == len(launches) or launches[i + 1][0] != name:
                    mark(name)
        graph: Any = capture.graph
        times: dict[str, list[float]] = {name: [0.0] * repeat for name, _ in marks[1:]}
        for i in range(repeat):
            wp.capture_launch(graph)
            wp.synchronize_device(device)
            for (_, begin), (name, end) in itertools.pairwise(marks):
                times[name][i] += wp.get_event_elapsed_time(begin, end)
        return times

    def record(self) -> Any:
        """Return the launches as a graph that `wp.capture_save` can write, after they have run once.

        They run one after another in it, on CUDA as well. On the CPU there must be one thread.
        """
        with self._one_stream(), wp.ScopedCapture(device=self._device, apic=True) as capture:
            self._run_eagerly()
        return capture.graph

    @contextmanager
    def _one_stream(self) -> Iterator[None]:
        """On CUDA, let nothing run beside something else."""
        side, self._side = self._side, None
        try:
            yield
        finally:
            self._side = side

    def _capture(self) -> None:
        with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
            self._run_eagerly()
        self._graph = capture.graph

    def _run_eagerly(self) -> None:
        if self._side is not None:
            self._main = self._device.stream
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
        """Let the worker threads end; one that hangs is not waited for."""
        if self._executor:
            self._executor.shutdown(wait=False, cancel_futures=True)
