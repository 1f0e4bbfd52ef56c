"""The naive kernels in sequence, with the inputs, cloud, history and noise of a `Planner`."""

from __future__ import annotations

import time
from typing import Any

import warp as wp
from numpy.typing import NDArray

from aero_planner import Planner
from aero_planner.config import Value
from benchmarks.naive import guides, mppi, partition, stage2
from benchmarks.naive.arrays import allocate, connect

NEUTRAL: dict[str, Value] = {
    "vehicle.delay": 0.0,
    "vehicle.disturbance_time": 0.0,
    "vehicle.drag_time": 0.0,
    "partition.range_time": 0.0,
    "partition.continue_below": 0.0,
    "partition.continue_above": 0.0,
    "anchors.lookahead_time": 0.0,
    "candidates.prove_stop": "off",
    "candidates.brake_seen": False,
    "candidates.speed_margin": 0.0,
    "costs.q_height": 0.0,
    "escape.q_escape": 0.0,
}
"""Values of the options that the naive kernels lack: they switch each of them off."""

_STAGES = ("anchors", "partition", "guides", "rollouts", "clearance", "update", "stage2")


class NaivePlanner:
    """Repeats the plans of a `Planner` from the same device arrays, with one plain launch after another.

    Call `take_over` before `planner.plan` and `run` after it, so that both start from the same history and noise.

    Args:
        planner: the planner to follow; its configuration must not change afterwards.

    Attributes:
        arrays: device arrays of the last run, see `benchmarks.naive.arrays.Arrays`.
        stage_ms: time of each stage of the last `run` [ms]; on CUDA the time of launching only.

    Raises:
        ValueError: the configuration uses an option that the naive kernels lack, see `NEUTRAL`.
    """

    def __init__(self, planner: Planner) -> None:
        lacking = [path for path, value in NEUTRAL.items() if planner.config.get(path) != value]
        if lacking:
            raise ValueError(f"the naive kernels lack {', '.join(lacking)}; replace them by the values of NEUTRAL.")
        self._planner = planner
        self._graph: Any = None
        self._device = wp.get_device(planner.device)
        self.stage_ms: dict[str, float] = {}
        self.arrays, self._names = allocate(planner)
        self.take_over()

    def take_over(self) -> None:
        """Copy the planner's history and draw the noise of its next plan."""
        history, a, work = self._planner.history(), self.arrays, self._planner.workspace
        for name in ("controls", "start_control", "end", "waypoint", "time"):
            getattr(a, f"previous_{name}").assign(getattr(history, name))
        a.tick.assign(history.tick)
        connect(a, self._planner)
        self._launch(mppi.draw_noise, a.cost.shape, work.seed, work.noise, a)

    def _launch(self, kernel: Any, dim: Any, *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(arguments or [self.arrays]), device=self._device)

    def run(self, *, first: str = "anchors") -> None:
        """Run the stages from `first` on; the results of earlier stages are taken from `arrays`."""
        connect(self.arrays, self._planner)
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
        """Return copies of `arrays` as NumPy arrays, by name, without the planner's own."""
        return {name: getattr(self.arrays, name).numpy().copy() for name in self._names}

    def _anchors(self) -> None:
        self._launch(partition.complete_goal, self.arrays.q0.shape)
        self._launch(partition.initial_anchors, self.arrays.direction.shape)

    def _partition(self) -> None:
        a = self.arrays
        a.keys.fill_(0xFFFFFFFFFFFFFFFF)
        a.dropped.zero_()
        a.count.zero_()
        self._launch(partition.cells_of_points, a.points.shape)
        self._launch(partition.fine_cells, a.keys.shape)
        self._launch(partition.coarse_cells, a.safe_range.shape)

    def _guides(self) -> None:
        a = self.arrays
        self._launch(partition.refined_anchors, a.direction.shape)
        self._launch(guides.guides, a.nominal.shape[:2])
        self._launch(guides.nominal_controls, a.nominal.shape[:2])

    def _rollouts(self) -> None:
        self._launch(mppi.rollouts, self.arrays.cost.shape)

    def _clearance(self) -> None:
        a = self.arrays
        M, shape = a.nominal.shape[1], a.sample_distance.shape
        self._launch(mppi.clearance, shape, M, a, a.sample_positions, a.sample_distance)
        self._launch(mppi.scores, a.cost.shape)

    def _update(self) -> None:
        a = self.arrays
        self._launch(mppi.softmin, a.cost.shape[0])
        self._launch(mppi.update, (a.cost.shape[0], a.nominal.shape[2]))

    def _stage2(self) -> None:
        a = self.arrays
        batch, count = a.best.shape, a.distance.shape[0]
        self._launch(stage2.braking_candidates, batch)
        self._launch(stage2.final_rollouts, count)
        self._launch(mppi.clearance, a.distance.shape, a.controls.shape[1], a, a.positions, a.distance)
        self._launch(stage2.final_scores, count)
        self._launch(stage2.select, batch)
        self._launch(stage2.commit, batch)
