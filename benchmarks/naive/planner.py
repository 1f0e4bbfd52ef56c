"""The naive kernels in sequence, with the inputs, cloud, history and noise of a `Planner`."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner import Planner
from aero_planner.kernels.params import Params, pack
from benchmarks.naive import guides, mppi, partition, stage2
from benchmarks.naive.model import PROBES

__all__ = ["NaivePlanner"]

_STAGES = ("anchors", "partition", "guides", "rollouts", "clearance", "update", "stage2")


class NaivePlanner:
    """Repeats the plans of a `Planner` from the same device arrays, with one plain launch after another.

    Call `take_over` before `planner.plan` and `run` after it, so that both start from the same history and noise.

    Args:
        planner: the planner to follow; its configuration must not change afterwards.

    Attributes:
        params: live parameters, shape [B].
        arrays: device arrays of the last run; instance i = b M + m, samples k, positions [B M, K, N + PROBES]. Arrays
            of Stage II also have rows for the braking candidates and for the midpoints between states.
        stage_ms: time of each stage of the last `run` [ms]; on CUDA the time of launching only.
    """

    def __init__(self, planner: Planner) -> None:
        config = planner.config
        part = config.partition
        self._planner, self._config = planner, config
        self._graph: Any = None
        self._device = wp.get_device(planner.device)
        self._batch = planner.inputs.position.shape[0]
        self._fine = (part.coarse_rows * part.fine_cells, part.coarse_columns * part.fine_cells)
        self.stage_ms: dict[str, float] = {}
        B, M, N, K = self._batch, len(config.kinds), config.sampling.steps, config.sampling.samples
        fine, coarse = self._fine[0] * self._fine[1], part.coarse_rows * part.coarse_columns
        with wp.ScopedDevice(self._device):
            self.params = wp.array(np.repeat(pack(config)[None], B), dtype=Params)
            self.arrays = SimpleNamespace(
                quaternion=wp.zeros(B, dtype=wp.vec4),
                goal_velocity=wp.zeros(B, dtype=wp.vec3),
                goal_quaternion=wp.zeros(B, dtype=wp.vec4),
                keys=wp.zeros((B, fine), dtype=wp.uint64),
                dropped=wp.zeros(B, dtype=int),
                fine_range=wp.zeros((B, fine), dtype=float),
                count=wp.zeros(B, dtype=int),
                filtered=wp.zeros((B, fine), dtype=wp.vec3),
                reach=wp.zeros(B, dtype=float),
                direction=wp.zeros((B, config.anchor_count), dtype=wp.vec3),
                safe_range=wp.zeros((B, coarse), dtype=float),
                safe_direction=wp.zeros((B, coarse), dtype=wp.vec3),
                anchor=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=wp.vec3),
                elapsed=wp.zeros(B, dtype=float),
                coefficient=wp.zeros((B, M + guides.BRAKING_CANDIDATES, 6), dtype=wp.vec3),
                guide=wp.zeros((B, M + guides.BRAKING_CANDIDATES, N + 1), dtype=wp.vec3),
                waypoint=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=wp.vec3),
                nominal=wp.zeros((B, M, N), dtype=wp.vec4),
                noise=wp.zeros((B * M, K, N), dtype=wp.vec4),
                sample_controls=wp.zeros((B * M, K, N), dtype=wp.vec4),
                sample_positions=wp.zeros((B * M, K, N + PROBES), dtype=wp.vec3),
                sample_distance=wp.zeros((B * M, K, N + PROBES), dtype=float),
                cost=wp.zeros((B * M, K), dtype=float),
                weight=wp.zeros((B * M, K), dtype=float),
                controls=wp.zeros((B, M + guides.BRAKING_CANDIDATES, N), dtype=wp.vec4),
                states=wp.zeros((B, M + guides.BRAKING_CANDIDATES, N + 1), dtype=wp.vec3),
                positions=wp.zeros((B * (M + guides.BRAKING_CANDIDATES), 1, N + PROBES + N), dtype=wp.vec3),
                distance=wp.zeros((B * (M + guides.BRAKING_CANDIDATES), 1, N + PROBES + N), dtype=float),
                J_goal=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=float),
                J_speed=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=float),
                J_col=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=float),
                S2=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=float),
                nearest=wp.zeros((B, M + guides.BRAKING_CANDIDATES), dtype=float),
                best=wp.zeros(B, dtype=int),
                status=wp.zeros(B, dtype=int),
                source=wp.zeros(B, dtype=int),
                previous_controls=wp.zeros((B, N), dtype=wp.vec4),
                previous_end=wp.zeros(B, dtype=wp.vec3),
                previous_waypoint=wp.zeros(B, dtype=wp.vec3),
                previous_time=wp.zeros(B, dtype=wp.float64),
                tick=wp.zeros(B, dtype=int),
            )
        self.take_over()

    def take_over(self) -> None:
        """Copy the planner's history and draw the noise of its next plan."""
        history, a = self._planner.history(), self.arrays
        a.previous_controls.assign(history.controls)
        a.previous_end.assign(history.end)
        a.previous_waypoint.assign(history.waypoint)
        a.previous_time.assign(history.time)
        a.tick.assign(history.tick)
        work = self._planner.workspace
        self._launch(mppi.draw_noise, a.cost.shape, self._M, work.seed, a.tick, self.params, work.noise, a.noise)

    @property
    def _M(self) -> int:
        return len(self._config.kinds)

    def _launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._device)

    def run(self, *, first: str = "anchors") -> None:
        """Run the stages from `first` on; the results of earlier stages are taken from `arrays`."""
        self.stage_ms = {}
        for name in _STAGES[_STAGES.index(first) :]:
            started = time.perf_counter()
            getattr(self, f"_{name}")()
            self.stage_ms[name] = 1e3 * (time.perf_counter() - started)

    def replay(self) -> None:
        """Run all stages as one CUDA graph, which the first call captures; on the CPU the same as `run`."""
        if self._device.is_cpu:
            return self.run()
        if self._graph is None:
            self.run()
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                self.run()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def result(self) -> dict[str, NDArray[Any]]:
        """Return copies of `arrays` as NumPy arrays, by name."""
        return {name: array.numpy().copy() for name, array in vars(self.arrays).items()}

    def _anchors(self) -> None:
        i, a, config = self._planner.inputs, self.arrays, self._config
        self._launch(
            partition.complete_goal, self._batch, i.position, i.quaternion, i.goal_position, i.goal_velocity,
            i.goal_quaternion, a.quaternion, a.goal_velocity, a.goal_quaternion,
        )  # fmt: skip
        self._launch(
            partition.initial_anchors, a.direction.shape, i.position, i.velocity, a.quaternion, i.goal_position,
            self.params, config.anchors.columns, config.anchors.rows, config.sampling.steps, a.reach, a.direction,
        )  # fmt: skip

    def _partition(self) -> None:
        i, a, points, part = self._planner.inputs, self.arrays, self._planner.points, self._config.partition
        a.keys.fill_(0xFFFFFFFFFFFFFFFF)
        a.dropped.zero_()
        a.count.zero_()
        self._launch(
            partition.cells_of_points, points.shape, points, i.point_count, i.position, a.quaternion, self.params,
            *self._fine, a.keys, a.dropped,
        )  # fmt: skip
        self._launch(partition.fine_cells, a.keys.shape, a.keys, points, self.params, a.fine_range, a.count, a.filtered)
        self._launch(
            partition.coarse_cells, a.safe_range.shape, a.fine_range, a.direction, part.fine_cells, part.coarse_rows,
            part.coarse_columns, a.safe_range, a.safe_direction,
        )  # fmt: skip

    def _guides(self) -> None:
        i, a, config = self._planner.inputs, self.arrays, self._config
        part, kinds = config.partition, config.kinds
        previous, brake = (kinds.index(kind) if kind in kinds else -1 for kind in ("previous", "brake"))
        self._launch(
            partition.refined_anchors, a.direction.shape, i.position, a.quaternion, self.params, a.fine_range, a.reach,
            a.direction, part.fine_cells, part.coarse_rows, part.coarse_columns, a.anchor,
        )  # fmt: skip
        self._launch(
            guides.guides, (self._batch, self._M), i.position, i.velocity, a.quaternion, i.acceleration, i.time,
            i.goal_position, a.goal_velocity, self.params, config.anchor_count, previous, brake, a.reach,
            a.previous_end, a.previous_waypoint, a.previous_time, a.anchor, a.elapsed, a.coefficient, a.guide,
            a.waypoint,
        )  # fmt: skip
        self._launch(
            guides.nominal_controls, (self._batch, self._M), a.quaternion, a.goal_quaternion, self.params, previous,
            brake, a.previous_controls, a.elapsed, a.coefficient, a.nominal,
        )  # fmt: skip

    def _states(self) -> list[wp.array]:
        i, a = self._planner.inputs, self.arrays
        return [i.position, i.velocity, a.quaternion, i.goal_position, a.goal_velocity, a.goal_quaternion, self.params]

    def _rollouts(self) -> None:
        a, kinds = self.arrays, self._config.kinds
        previous = kinds.index("previous") if "previous" in kinds else -1
        self._launch(
            mppi.rollouts, a.cost.shape, self._M, previous, *self._states(), a.guide, a.waypoint, a.nominal, a.noise,
            a.sample_controls, a.sample_positions, a.cost,
        )  # fmt: skip

    def _clearance(self) -> None:
        i, a = self._planner.inputs, self.arrays
        self._launch(
            mppi.clearance, a.sample_distance.shape, self._M, self._config.sampling.steps, i.ground_height,
            self.params, a.count, a.filtered, a.sample_positions, a.sample_distance,
        )  # fmt: skip
        self._launch(
            mppi.scores, a.cost.shape, self._M, i.goal_position, a.waypoint, self.params, a.sample_positions,
            a.sample_distance, a.cost,
        )  # fmt: skip

    def _update(self) -> None:
        a = self.arrays
        self._launch(mppi.softmin, a.cost.shape[0], self._M, self.params, a.cost, a.weight)
        self._launch(
            mppi.update, (a.cost.shape[0], a.controls.shape[2]), self._M, a.nominal, a.sample_controls, a.weight,
            a.controls,
        )  # fmt: skip

    def _stage2(self) -> None:
        i, a, kinds = self._planner.inputs, self.arrays, self._config.kinds
        self._launch(
            stage2.braking_candidates, self._batch, i.position, i.velocity, a.quaternion, i.acceleration, self.params,
            a.anchor, a.coefficient, a.guide, i.goal_position, a.waypoint, a.controls,
        )  # fmt: skip
        count, instances = a.positions.shape[0], self._M + guides.BRAKING_CANDIDATES
        self._launch(
            stage2.final_rollouts, count, instances, *self._states(), a.waypoint, a.controls, a.states, a.positions,
            a.J_goal, a.J_speed,
        )  # fmt: skip
        self._launch(
            mppi.clearance, a.distance.shape, instances, self._config.sampling.steps, i.ground_height, self.params,
            a.count, a.filtered, a.positions, a.distance,
        )  # fmt: skip
        self._launch(
            stage2.final_scores, count, instances, i.goal_position, a.waypoint, self.params, a.positions, a.distance,
            a.J_goal, a.J_speed, a.J_col, a.S2, a.nearest,
        )  # fmt: skip
        self._launch(
            stage2.select, self._batch, kinds.index("brake") if "brake" in kinds else -1, i.position, i.ground_height,
            self.params, i.cloud_age, a.count, a.filtered, a.S2, a.nearest, a.best, a.status, a.source,
        )  # fmt: skip
        self._launch(
            stage2.commit, self._batch, a.best, a.source, a.anchor, a.guide, a.controls, a.states, a.J_goal, a.J_col,
            a.S2,
        )  # fmt: skip
