"""What records the launches of a plan: the arrays as kernels take them, and the sizes of their launches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import warp as wp

from aero_planner.array_memory import array_specs
from aero_planner.arrays import CloudArrays, PlannerInputs, PlannerOutputs, Sizes, Workspace
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.device import records
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.records import bundle
from aero_planner.kernels.sweep_change import RECENT


@dataclass(frozen=True, eq=False)
class PlannerArrays:
    """Arrays that the launches of a plan read and write, all on one device."""

    inputs: PlannerInputs
    outputs: PlannerOutputs
    work: Workspace
    of_stages: Mapping[str, tuple[Any, Any]]
    """Arrays and outputs of each active stage by its name; None where it declares none."""
    cloud: CloudArrays
    """The sweeps to plan from."""
    change: wp.array | None
    """How these sweeps change; None for a cloud that the caller has joined."""
    params: wp.array
    """Live parameters, shape [B]."""

    def groups(self) -> list[Any]:
        """Return all dataclasses of arrays: those of the core, then those of the stages."""
        return [self.inputs, self.outputs, self.work, *stage_groups(self.of_stages)]


def stage_groups(of_stages: Mapping[str, tuple[Any, Any]]) -> list[Any]:
    """Return the dataclasses of arrays of all stages."""
    return [group for groups in of_stages.values() for group in groups if group is not None]


class Recorder:
    """The arrays of a planner as kernels take them. `record` is `LaunchSequence.record`.

    Args:
        record: records a launch and returns the function that runs it.
        config: configuration, of which only the structure is used.
        composition: its composition.
        sizes: sizes of the arrays.
        tuning: tuning of the device for one drone.
        arrays: arrays of the planner.

    Attributes:
        batch_tuning: tuning of the device for the batch.
        problem, start, cells, grid, guides, rollouts, scores, choice, previous, views, sweeps: the structs of
            `aero_planner.device.records`, and the views of the stages.
    """

    def __init__(
        self,
        record: Callable[..., Callable[[], Any]],
        config: PlannerConfig,
        composition: Composition,
        sizes: Sizes,
        tuning: KernelTuning,
        arrays: PlannerArrays,
    ) -> None:
        self.record, self.config, self.composition, self.sizes = record, config, composition, sizes
        self.tuning, self.batch_tuning, self.arrays = tuning, tuning.for_batch(sizes.B), arrays
        i, o, w = arrays.inputs, arrays.outputs, arrays.work
        self.inputs, self.outputs, self.work = i, o, w
        self.params, self.change = arrays.params, arrays.change
        self.problem = bundle(
            records.Problem, active=w.active, given_goal=i.goal_position, goal=w.goal,
            **{name: getattr(i, name) for name in (
                "time", "position", "velocity", "quaternion", "acceleration", "disturbance", "goal_velocity",
                "goal_quaternion", "cloud_age", "is_blind", "ground_height",
            )},
        )  # fmt: skip
        self.start = bundle(
            records.Start, disturbance=o.disturbance, drag=o.drag,
            **{name: getattr(w, name) for name in (
                "position", "velocity", "quaternion", "acceleration", "command", "control", "period", "goal_velocity",
                "goal_quaternion", "lookahead", "clip_guides",
            )},
        )  # fmt: skip
        self.cells = bundle(
            records.Cells, rows=sizes.F0, columns=sizes.F1, directions=w.fine_directions, range=o.fine_range,
            occupied=o.occupied, points=o.filtered_points,
        )  # fmt: skip
        self.grid = bundle(
            records.grid_struct(tuning.points_per_pack), duplicate_rows=self.batch_tuning.duplicate_rows,
            ends=w.cell_ends, packs=w.point_packs,
        )  # fmt: skip
        self.guides = bundle(
            records.GuideSet, initial_endpoints=o.initial_endpoints, anchors=o.anchors,
            coefficients=o.guide_coefficients, positions=o.guides,
        )  # fmt: skip
        self.rollouts = bundle(
            records.Rollouts, controls=o.controls, positions=o.positions, velocities=o.velocities,
            quaternions=o.quaternions,
        )  # fmt: skip
        self.scores = bundle(
            records.Scores, goal_cost=o.goal_cost, collision_cost=o.collision_cost, stage2_cost=o.stage2_cost,
            clearance=o.clearance, state_clearance=w.state_clearance, static_clearance=w.static_clearance,
            least_clearance=w.least_clearance,
        )  # fmt: skip
        self.choice = bundle(records.Choice, best=o.best, status=o.status, replaced=o.braking_instance, flown=o.flown)
        self.previous = bundle(
            records.PreviousPlan, tick=w.tick, time=w.previous_time, controls=w.previous_controls,
            start_control=w.previous_start_control, end=w.previous_end, blind_time=w.blind_time,
        )  # fmt: skip
        self.sweeps = arrays.cloud.bundle()
        viewed = [stage for stage in composition.stages if stage.view is not None]
        self.views = bundle(composition.Views, **{stage.name: self.bind(stage.view, stage.name) for stage in viewed})

    def stage_arrays(self, name: str) -> Any:
        """Return the arrays that a stage declares."""
        return self.arrays.of_stages[name][0]

    def bind(self, struct: Any, name: str) -> Any:
        """Return a Warp struct whose fields have the names of arrays of a stage, of its outputs, or of the core."""
        groups = [group for group in self.arrays.of_stages[name] if group is not None]
        groups += [self.outputs, self.work, self.inputs]
        named = {key: getattr(group, key) for group in reversed(groups) for key in array_specs(type(group))}
        return bundle(struct, **{field: named[field] for field in struct.vars})

    def view(self, name: str) -> Any:
        """Return the view of a stage."""
        return getattr(self.views, name)

    @cached_property
    def threads_per_sweep(self) -> int:
        """Number of threads that go through the points of a recent sweep."""
        return self.tuning.threads_per_sweep(self.sizes.B * int(RECENT), self.arrays.cloud.points.shape[1])

    def threads_of_cells(self, workers: int) -> tuple[int, int]:
        """Return the size of a launch in which the threads of `workers` workers share the fine cells."""
        return self.sizes.B, -(-self.sizes.F // (workers * self.tuning.cells_per_thread))
