"""The stages of a plan as kernel launches, recorded once per structure and replayed for every plan.

On the CPU the heavy stages are split into chunks, slices of the points or of the instances, for the worker threads. On
CUDA every stage is one chunk.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import warp as wp

from aero_planner.array_memory import as_scalars, as_vectors
from aero_planner.arrays import Sizes
from aero_planner.cloud_stages import CloudStages
from aero_planner.config import PlannerConfig
from aero_planner.kernels import (
    anchors,
    clearance,
    continuation,
    guides,
    movers,
    mppi,
    partition,
    prediction,
    sample_clearance,
    selection,
    stop_proof,
    stops,
)
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.launch_sequence import PLAN, Chunk, LaunchSequence
from aero_planner.pipeline_records import PipelineArrays, PipelineRecords
from aero_planner.sweep_stages import SweepStages

PLAN_AND_ARRIVAL = "plan and arrival"
"""Name of the stages that plan and meanwhile take a sweep into the memory."""


def tuned_kernels(tuning: KernelTuning) -> list[tuple[wp.Kernel, int]]:
    """Return every kernel made for a tuning, for one drone and for many, and the block size of its launches."""
    many = tuning.for_batch(1024)
    for_cpu = [(stop_proof.prove_stops(many), 256), (sample_clearance.query_sample_vectors(tuning), 256)]
    return ([] if tuning.is_cuda else for_cpu) + [
        (partition.scatter_points(tuning), 256),
        (continuation.find_edges(tuning), 256),
        (continuation.continue_surfaces(tuning), 256),
        (clearance.fill_rows(tuning), 256),
        (guides.make_guides(tuning), 32),
        (mppi.sample_rollouts(tuning), 32),
        (sample_clearance.query_clearance(tuning), 128),
        (sample_clearance.query_clearance(many), 128),
        (mppi.update_controls(tuning), tuning.threads_per_update),
        (mppi.update_controls(many), many.threads_per_update),
        (selection.roll_out_controls(tuning), 32),
        (selection.evaluate_states(tuning), 32),
        (selection.evaluate_states(many), 32),
        (selection.score_instances(tuning), 32),
        (selection.commit_plan(tuning), 32),
        (stops.roll_out_stops(tuning), 32),
        (stop_proof.evaluate_stops(tuning), 32),
        (stop_proof.evaluate_stops(many), 32),
    ]


class Pipeline(LaunchSequence):
    """The launches of a plan over the planner's arrays.

    Args:
        config: configuration, of which only the structure is used.
        sizes: sizes of the arrays.
        tuning: tuning of the device for one drone.
        arrays: arrays of the planner.
    """

    def __init__(
        self,
        config: PlannerConfig,
        sizes: Sizes,
        tuning: KernelTuning,
        arrays: PipelineArrays,
    ) -> None:
        super().__init__(wp.get_device(str(arrays.params.device)), sizes.W)
        self._config, self._sizes = config, sizes
        self._tuning, self._batch_tuning = tuning, tuning.for_batch(sizes.B)
        self._inputs, self._outputs, self._work = arrays.inputs, arrays.outputs, arrays.work
        self._cloud, self._newest, self._params = arrays.cloud, arrays.motion.arrays.newest, arrays.params
        kinds = config.kinds
        self._previous_index = kinds.index("previous") if "previous" in kinds else -1
        self._brake_index = kinds.index("brake") if "brake" in kinds else -1
        cloud_stages = CloudStages(self, config, sizes, tuning, arrays)  # not kept, since they refer to this object
        self._duplicate_rows = cloud_stages.duplicate_rows
        self._records = PipelineRecords(arrays.inputs, arrays.outputs, arrays.work)
        self._record_stages(arrays, cloud_stages)

    # --- the stages, in order ---

    def _record_stages(self, arrays: PipelineArrays, cloud: CloudStages) -> None:
        """Record all launches. On CUDA, branches run in parallel with the stages up to their join."""
        predict = self.serial("anchors", *self.branch("anchors", self._predict_state()))
        place_anchors = self.serial("anchors", *self.branch("anchors", self._place_anchors(), after="anchors"))
        place_movers = self._place_movers()
        movers = self.serial("anchors", *self.branch("movers", place_movers, after="anchors"))
        scan = cloud.scan_points()
        reset_keys = arrays.work.cell_keys.zero_
        reset_grid = arrays.work.cell_ends.zero_, arrays.work.points_used.zero_
        # No later stage needs the coarse cells. Beside the guides they would delay these.
        late = [cloud.pool_coarse_cells(), *([reset_keys] if self._device.is_cuda else [])]
        pool = self.serial("partition", *self.branch("pool", *late, after="grid"))
        plan = [
            cloud.finish_fine_cells(),
            self.serial("partition", self.join("anchors")),
            cloud.find_surfaces(),
            cloud.find_nearest_surfaces(),
            cloud.continue_surfaces(),
            self.serial("grid", self.fork("grid"), *reset_grid),  # until the first clearance query
            cloud.build_clearance_grid(),
            self.serial("guides", self.end_fork("grid"), self._make_guides()),
            *([pool] if self._device.is_cuda else []),
            self._optimize(),
            *self._select_instance(pool),
        ]
        # A GPU starts the first launches one after another, in the order in which they are recorded.
        self.stages[PLAN] = [predict, scan, place_anchors, movers, *plan]
        if self._device.is_cpu:  # here the plan before may have been interrupted
            reset = self.serial("partition", reset_keys, arrays.work.worker_dropped.zero_)
            self.stages[PLAN].insert(0, reset)
        if arrays.change is not None and self._device.is_cuda:
            sweeps = SweepStages(self, arrays.cloud, arrays.change, arrays.motion)
            self.stages[PLAN_AND_ARRIVAL] = [
                self.serial("motion", *self.branch("movers", *sweeps.estimate_motion(), place_movers)),
                predict,
                self.serial("partition", *sweeps.thin()),
                scan,
                place_anchors,
                self.serial("order", *self.branch("order", *sweeps.order_points())),  # this plan reads without order
                *plan,
                self.serial("order", self.join("order")),
            ]

    def _place_anchors(self) -> Callable[[], Any]:
        i, o, w, r, anchor_config = self._inputs, self._outputs, self._work, self._records, self._config.anchors
        return self.record(
            anchors.place_anchors,
            (self._sizes.B, self._sizes.A),
            inputs=[
                r.drone, i.time, r.given_goal, self._params, anchor_config.columns, anchor_config.rows, self._sizes.N,
                w.tick, r.escape, r.previous,
            ],
            outputs=[
                w.command, w.control, r.goal, w.lookahead_length, w.clip_guides, w.initial_directions,
                o.initial_endpoints,
            ],
        )  # fmt: skip

    def _predict_state(self) -> Callable[[], Any]:
        r = self._records
        return self.record(
            prediction.predict_state,
            (self._sizes.B,),
            inputs=[r.given_drone, self._inputs.time, self._params, r.previous],
            outputs=[self._work.mean_disturbance, self._work.drag_means, self._work.view_quaternion, r.drone],
        )

    def _place_movers(self) -> Callable[[], Any]:
        r = self._records
        return self.record(
            movers.place_movers,
            (self._sizes.B,),
            inputs=[self._inputs.time, self._params, self._newest, self._cloud.bundle()],
            outputs=[r.movers],
        )

    def _make_guides(self) -> Callable[[], Any]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        part = self._config.partition
        return self.record(
            guides.make_guides(self._tuning),
            (sizes.B, sizes.R, self._tuning.threads_per_instance),
            inputs=[
                r.drone, i.time, r.goal, self._params, sizes.M, sizes.A, self._previous_index,
                part.fine_cells, part.coarse_rows, part.coarse_columns, o.fine_range, w.fine_directions,
                w.lookahead_length, w.clip_guides, w.initial_directions, r.previous,
            ],
            outputs=[r.guides, w.waypoints, w.nominal_controls, w.plan_period, w.stop_ready, w.stop_command],
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
                ("clearance", self.join("grid")),
                ("clearance", self.join("movers")),
                ("clearance", self._query_clearance(first, end - first)),
                ("update", self._update_controls(first, end - first)),
            ]
            for first, end in itertools.pairwise(bounds)
        ]

    def _sample_rollouts(self, first: int, count: int) -> Callable[[], Any]:
        o, w, r, sizes, width = self._outputs, self._work, self._records, self._sizes, self._tuning.samples_per_thread
        return self.record(
            mppi.sample_rollouts(self._tuning),
            (count, sizes.L // width),
            inputs=[
                first, sizes.M, self._previous_index, w.finished, r.drone, r.goal, self._params, w.seed, w.tick,
                as_vectors(w.noise, width), o.guides, w.waypoints, w.nominal_controls,
            ],
            outputs=[
                as_vectors(w.sample_controls, width), as_vectors(w.sample_positions, width),
                as_vectors(o.stage1_cost, width),
            ],
            block_dim=32,
        )  # fmt: skip

    def _query_clearance(self, first: int, count: int) -> Callable[[], Any]:
        i, w, r, sizes = self._inputs, self._work, self._records, self._sizes
        if not self._tuning.is_cuda:
            return self.record(
                sample_clearance.query_sample_vectors(self._tuning),
                (count, sizes.Q),
                inputs=[
                    first, sizes.M, sizes.N, w.finished, i.position, i.ground_height, r.movers, self._params,
                    w.cell_ends, w.point_packs, as_vectors(w.sample_positions, self._tuning.samples_per_thread),
                ],
                outputs=[w.sample_clearance_cost],
            )  # fmt: skip
        tuning = self._batch_tuning
        return self.record(
            sample_clearance.query_clearance(tuning),
            (count, -(-sizes.Q // tuning.rows_per_sample_query), sizes.K * tuning.threads_per_sample_query),
            inputs=[
                first, sizes.M, sizes.N, w.finished, i.position, i.ground_height, r.movers, self._params,
                self._duplicate_rows, w.cell_ends, w.point_packs, w.sample_positions,
            ],
            outputs=[w.sample_clearance_cost],
            block_dim=128,
        )  # fmt: skip

    def _update_controls(self, first: int, count: int) -> Callable[[], Any]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        threads, width = self._batch_tuning.threads_per_update, self._tuning.samples_per_read
        sample_controls = as_vectors(w.sample_controls, width).reshape((sizes.B * sizes.M, sizes.N * 4, -1))
        return self.record(
            mppi.update_controls(self._batch_tuning),
            (count, threads),
            inputs=[
                first, sizes.M, w.finished, i.goal_position, self._params, r.escape, w.waypoints,
                as_scalars(w.nominal_controls), sample_controls, w.sample_positions, w.sample_clearance_cost,
            ],
            outputs=[o.stage1_cost, w.sample_weights, as_vectors(w.sample_weights, width), as_scalars(o.controls)],
            block_dim=threads,
        )  # fmt: skip

    def _select_instance(self, pool: list[Chunk]) -> list[list[Chunk]]:
        """Stage II: roll out the optimised controls, sum S2, find the clearance of the stops, and choose.

        On a CPU stops are only proven as far as the choice needs it, and `pool` runs beside the rollouts. On CUDA the
        rollouts of the stops are the longest launch.
        """
        roll_out, evaluate, score = self._evaluate_instances()
        if not self._tuning.is_cuda:
            prove = self._prove_stops()
            return [
                [*pool, *self.serial("stage2", roll_out, evaluate)],
                self.serial("stage2", score, prove, self._commit_plan()),
            ]
        roll_out_stops, evaluate_stops = self._evaluate_all_stops()
        return [
            self.serial("stage2", roll_out, *self.branch("stops", roll_out_stops), evaluate),
            self.serial("stage2", self.join("stops"), *self.branch("score", score), evaluate_stops, self.join("score")),
            self.serial("stage2", self._commit_plan(), self.join("pool")),
        ]

    def _evaluate_instances(self) -> list[Callable[[], Any]]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        lanes, threads = self._tuning.threads_per_instance, self._batch_tuning.threads_per_query
        roll_out = self.record(
            selection.roll_out_controls(self._tuning),
            (sizes.B, sizes.R, lanes),
            inputs=[r.drone, self._params, sizes.M, w.nominal_controls],
            outputs=[r.rollouts],
            block_dim=32,
        )
        evaluate = self.record(
            selection.evaluate_states(self._batch_tuning),
            (sizes.B, sizes.R, sizes.Q + sizes.N + 1, threads),
            inputs=[
                w.finished, r.drone, i.position, i.ground_height, r.goal, r.movers, self._params, self._duplicate_rows,
                w.cell_ends, w.point_packs, w.waypoints, r.rollouts,
            ],
            outputs=[o.clearance, w.state_terms, w.standing_clearance],
            block_dim=32,
        )  # fmt: skip
        score = self.record(
            selection.score_instances(self._tuning),
            (sizes.B, sizes.R, lanes),
            inputs=[
                i.position, i.quaternion, i.goal_position, w.command, self._params, sizes.M, self._previous_index,
                sizes.F0, sizes.F1, o.fine_range, r.escape, w.waypoints, o.controls, o.positions, w.state_terms,
                w.standing_clearance,
            ],
            outputs=[r.costs, w.instance_scores],
            block_dim=32,
        )  # fmt: skip
        return [roll_out, evaluate, score]

    def _prove_stops(self) -> Callable[[], Any]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        return self.record(
            stop_proof.prove_stops(self._batch_tuning),
            (sizes.B,),
            inputs=[
                w.finished, r.drone, i.position, i.quaternion, i.ground_height, r.movers, self._params, sizes.M,
                sizes.Q - sizes.N, self._duplicate_rows, sizes.F0, sizes.F1, o.fine_range, w.plan_period, r.rollouts,
                w.cell_ends, w.point_packs, w.state_terms, w.standing_clearance, w.instance_scores, w.stop_ready,
            ],
            outputs=[w.stop_controls, w.stop_positions, w.stop_clearance],
        )  # fmt: skip

    def _evaluate_all_stops(self) -> list[Callable[[], Any]]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        roll_out = self.record(
            stops.roll_out_stops(self._tuning),
            (sizes.B, sizes.M * sizes.J),
            inputs=[w.finished, r.drone, self._params, w.plan_period, r.rollouts],
            outputs=[w.stop_controls, w.stop_positions, w.stop_clearance],
            block_dim=32,
        )
        evaluate = self.record(
            stop_proof.evaluate_stops(self._batch_tuning),
            (sizes.B, sizes.M * sizes.J, 4 * sizes.N, self._batch_tuning.threads_per_stop_query),
            inputs=[
                w.finished, i.position, i.quaternion, i.ground_height, r.movers, self._params, sizes.Q - sizes.N,
                self._duplicate_rows, sizes.F0, sizes.F1, o.fine_range, o.positions, w.plan_period, w.cell_ends,
                w.point_packs, w.stop_positions, w.state_terms, w.standing_clearance,
            ],
            outputs=[w.stop_clearance],
            block_dim=32,
        )  # fmt: skip
        return [roll_out, evaluate]

    def _commit_plan(self) -> Callable[[], Any]:
        i, o, w, r, sizes = self._inputs, self._outputs, self._work, self._records, self._sizes
        return self.record(
            selection.commit_plan(self._tuning),
            (sizes.B, self._tuning.threads_per_instance),
            inputs=[
                i.time, i.position, i.goal_position, i.cloud_age, w.control, self._params, sizes.M, self._brake_index,
                w.waypoints, w.standing_clearance, w.instance_scores, w.plan_period, w.stop_ready, w.stop_command,
                w.stop_controls, w.stop_clearance,
            ],
            outputs=[
                r.guides, r.rollouts, r.costs, o.clearance, w.tick, r.escape, o.best, o.status,
                o.braking_instance, r.previous,
            ],
            block_dim=32,
        )  # fmt: skip
