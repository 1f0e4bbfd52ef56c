"""The launches of a plan, in order: partition, anchors, guides, Stage I, Stage II, selection, and those of stages."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import warp as wp

from aero_planner.array_memory import as_scalars, as_vectors
from aero_planner.arrays import Sizes
from aero_planner.cloud_launches import (
    build_clearance_grid,
    finish_fine_cells,
    order_points,
    pool_coarse_cells,
    scan_points,
    stamp_sweep,
    thin_sweep,
)
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.kernels import anchors, guides, mppi, prediction, sample_clearance, selection
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.launch_sequence import PLAN, RESET, Chunk, LaunchSequence
from aero_planner.recorder import PlannerArrays, Recorder

ARRIVAL = "arrival"
"""Name of the stages that take a sweep into the memory."""
PLAN_AND_ARRIVAL = "plan and arrival"
"""Name of the stages that do so while they plan."""


class Pipeline(LaunchSequence):
    """All launches of a plan.

    Args:
        config: configuration, of which only the structure is used.
        composition: its composition.
        sizes: sizes of the arrays.
        tuning: tuning of the device for one drone.
        arrays: arrays of the planner.
        dry: True to note the kernels only, without a device that could run them.
    """

    def __init__(
        self,
        config: PlannerConfig,
        composition: Composition,
        sizes: Sizes,
        tuning: KernelTuning,
        arrays: PlannerArrays,
        *,
        dry: bool = False,
    ) -> None:
        super().__init__(wp.get_device(str(arrays.params.device)), sizes.W, dry=dry)
        # Not kept, since it refers to this object.
        recorder = Recorder(self.record, config, composition, sizes, tuning, arrays)
        _Stages(self, recorder).record()


class _Stages:
    """Records the stages of a plan. On CUDA, branches run in parallel with the stages up to their join."""

    def __init__(self, sequence: LaunchSequence, recorder: Recorder) -> None:
        self._sequence, self._r = sequence, recorder
        self._branch, self._serial = sequence.branch, sequence.serial
        self._previous_index = recorder.config.previous_index

    def record(self) -> None:
        s, r, w = self._sequence, self._r, self._r.work
        reset_keys, reset_grid = w.cell_keys.zero_, (w.cell_ends.zero_, w.points_used.zero_)
        predict = self._serial("anchors", *self._branch("anchors", self._predict_state()))
        place_anchors = self._serial(
            "anchors", *self._branch("anchors", *self._flat("start"), self._place_anchors(), after="anchors")
        )
        beside = self._flat("beside")
        scan = scan_points(r)
        # No later stage needs the coarse cells. Beside the guides they would delay these.
        pool = self._serial("partition", *self._branch("pool", pool_coarse_cells(r), reset_keys, after="grid"))
        guide_rows = self._flat("guides")
        plan = [
            finish_fine_cells(r),
            self._serial("partition", s.join("anchors")),
            *self._named("partition", "cells"),
            self._serial("grid", s.fork("grid"), *reset_grid),  # until the first clearance query
            build_clearance_grid(r),
            self._serial("guides", s.end_fork("grid"), *self._branch("guides", *guide_rows), self._make_guides()),
            self._optimize(),
            *self._select(pool),
        ]
        # A GPU starts the first launches one after another, in the order in which they are recorded.
        s.stages[PLAN] = [
            predict, scan, place_anchors, self._serial("beside", *self._branch("beside", *beside)), *plan,
        ]  # fmt: skip
        s.stages[RESET] = [self._serial("reset", reset_keys, w.worker_dropped.zero_)]
        if r.change is not None:
            arrive = [stamp_sweep(r), *self._flat("arrival")]
            thin, order = thin_sweep(r), order_points(r)
            s.stages[ARRIVAL] = [self._serial(ARRIVAL, *arrive, thin, *order)]
            s.stages[PLAN_AND_ARRIVAL] = [
                self._serial("partition", *arrive),
                self._serial("beside", *self._branch("beside", *beside)),
                predict,
                self._serial("partition", thin),
                scan,
                place_anchors,
                self._serial("order", *self._branch("order", *order)),  # this plan reads without order
                *plan,
                self._serial("order", s.join("order")),
            ]

    def _named(self, name: str, place: str) -> list[list[Chunk]]:
        """Return the steps of all stages at a place, whose time is counted under a name."""
        stages = [stage for stage in self._r.composition.stages if place in stage.launches]
        return [
            [chunk for launches in step for chunk in self._serial(name, *launches)]
            for stage in stages
            for step in stage.launches[place](self._r)
        ]

    def _flat(self, place: str) -> list[Callable[[], Any]]:
        """Return the launches of all stages at a place, one after another."""
        return [launch for step in self._named(place, place) for chunk in step for _, launch in chunk]

    def _predict_state(self) -> Callable[[], Any]:
        r = self._r
        return r.record(
            prediction.predict_state(r.composition),
            (r.sizes.B,),
            inputs=[r.problem, r.params, r.previous, r.views],
            outputs=[r.start],
        )

    def _place_anchors(self) -> Callable[[], Any]:
        r, config = self._r, self._r.config.anchors
        return r.record(
            anchors.place_anchors(r.composition),
            (r.sizes.B, r.sizes.A),
            inputs=[r.problem, r.params, config.columns, config.rows, r.sizes.N, r.previous, r.views],
            outputs=[r.start, r.work.initial_directions, r.outputs.initial_endpoints],
        )

    def _make_guides(self) -> Callable[[], Any]:
        r, sizes = self._r, self._r.sizes
        return r.record(
            guides.make_guides(r.tuning, r.composition),
            (sizes.B, sizes.M + int(BRAKING_FAN), r.tuning.threads_per_instance),
            inputs=[
                r.problem, r.start, r.params, sizes.M, sizes.A, self._previous_index, r.cells,
                r.work.initial_directions, r.previous, r.views,
            ],
            outputs=[r.guides, r.work.nominal_controls],
            block_dim=32,
        )  # fmt: skip

    def _optimize(self) -> list[Chunk]:
        """Stage I: sample, query the clearance and update the controls, for a slice of the instances per chunk."""
        sizes, s = self._r.sizes, self._sequence
        instances = sizes.B * sizes.M
        # More chunks than workers, since instances among obstacles take longer than those in the open.
        count = min(instances, 4 * sizes.W) if sizes.W > 1 else 1
        bounds = [instances * chunk // count for chunk in range(count + 1)]
        return [
            [
                ("rollouts", self._sample_rollouts(first, end - first)),
                ("clearance", s.join("grid")),
                ("clearance", s.join("beside")),
                ("clearance", self._query_clearance(first, end - first)),
                ("update", self._update_controls(first, end - first)),
            ]
            for first, end in itertools.pairwise(bounds)
        ]

    def _sample_rollouts(self, first: int, count: int) -> Callable[[], Any]:
        r, w, o, width = self._r, self._r.work, self._r.outputs, self._r.tuning.samples_per_thread
        return r.record(
            mppi.sample_rollouts(r.tuning, r.composition),
            (count, r.sizes.L // width),
            inputs=[
                first, r.sizes.M, self._previous_index, r.problem, r.start, r.params, w.seed, w.tick,
                as_vectors(w.noise, width), o.guides, w.nominal_controls,
            ],
            outputs=[
                as_vectors(w.sample_controls, width), as_vectors(w.sample_positions, width),
                as_vectors(o.stage1_cost, width),
            ],
            block_dim=32,
        )  # fmt: skip

    def _query_clearance(self, first: int, count: int) -> Callable[[], Any]:
        r, w, sizes, tuning = self._r, self._r.work, self._r.sizes, self._r.batch_tuning
        width = tuning.samples_per_thread
        threads = sizes.K * tuning.threads_per_sample_query if width == 1 else 1
        return r.record(
            sample_clearance.query_clearance(tuning, r.composition),
            (count, -(-sizes.Q // tuning.rows_per_sample_query), threads),
            inputs=[
                first, sizes.M, sizes.N, r.problem, r.params, r.grid, r.views,
                w.sample_positions if width == 1 else as_vectors(w.sample_positions, width),
            ],
            outputs=[w.sample_clearance_cost],
            block_dim=128,
        )  # fmt: skip

    def _update_controls(self, first: int, count: int) -> Callable[[], Any]:
        r, w, o, sizes = self._r, self._r.work, self._r.outputs, self._r.sizes
        threads, width = r.batch_tuning.threads_per_update, r.tuning.samples_per_read
        sample_controls = as_vectors(w.sample_controls, width).reshape((sizes.B * sizes.M, sizes.N * 4, -1))
        return r.record(
            mppi.update_controls(r.batch_tuning, r.composition),
            (count, threads),
            inputs=[
                first, sizes.M, r.problem, r.params, r.views, as_scalars(w.nominal_controls), sample_controls,
                w.sample_positions, w.sample_clearance_cost,
            ],
            outputs=[
                o.stage1_cost, o.temperature, w.sample_weights, as_vectors(w.sample_weights, width),
                as_scalars(o.controls),
            ],
            block_dim=threads,
        )  # fmt: skip

    def _select(self, pool: list[Chunk]) -> list[list[Chunk]]:
        """Stage II: roll out the optimised controls, sum S2, and choose; `pool` runs beside the rollouts."""
        s, serial = self._sequence, self._serial
        roll_out, evaluate, score = self._evaluate_instances()
        rollouts, proof = self._named("stage2", "rollouts"), self._named("stage2", "proof")
        # Launches of stages run beside those of the core: on CUDA on a branch, on a CPU as chunks for the workers.
        begin = serial("stage2", s.fork("rollouts"))
        end = serial("stage2", s.end_fork("rollouts"))
        return [
            [*pool, *serial("stage2", s.join("guides"), roll_out)],
            begin,
            *rollouts,
            end,
            serial("stage2", evaluate, s.join("rollouts"), *self._branch("score", score)),
            *proof,
            serial("stage2", s.join("score"), self._commit_plan(), *self._flat("end"), s.join("pool")),
        ]

    def _evaluate_instances(self) -> list[Callable[[], Any]]:
        r, w, sizes = self._r, self._r.work, self._r.sizes
        lanes, threads = r.tuning.threads_per_instance, r.batch_tuning.threads_per_query
        roll_out = r.record(
            selection.roll_out_controls(r.tuning, r.composition),
            (sizes.B, sizes.R, lanes),
            inputs=[r.start, r.params, sizes.M, w.nominal_controls],
            outputs=[r.rollouts],
            block_dim=32,
        )
        evaluate = r.record(
            selection.evaluate_states(r.batch_tuning, r.composition),
            (sizes.B, sizes.R, sizes.Q + 1, threads),
            inputs=[
                r.problem, r.start, r.params, self._previous_index, r.grid, r.views, r.outputs.guides, r.rollouts,
            ],
            outputs=[w.state_costs, r.scores],
            block_dim=32,
        )  # fmt: skip
        score = r.record(
            selection.score_instances(r.tuning, r.composition),
            (sizes.B, sizes.R, lanes),
            inputs=[r.problem, r.params, r.views, r.outputs.positions, w.state_costs],
            outputs=[r.scores],
            block_dim=32,
        )
        return [roll_out, evaluate, score]

    def _commit_plan(self) -> Callable[[], Any]:
        r = self._r
        return r.record(
            selection.commit_plan(r.tuning, r.composition),
            (r.sizes.B, r.tuning.threads_per_instance),
            inputs=[r.problem, r.start, r.params, r.sizes.M, r.views],
            outputs=[r.rollouts, r.scores, r.choice, r.previous],
            block_dim=32,
        )
