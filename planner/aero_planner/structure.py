"""What a planner holds for the structure of its configuration: the composition, and the arrays of its sizes."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.array_memory import PackedArrays, allocate, forget
from aero_planner.arrays import PlannerOutputs, Sizes, Workspace
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.kernels.mppi import fill_noise
from aero_planner.kernels.partition import fill_directions
from aero_planner.recorder import stage_groups


@dataclass(frozen=True, eq=False)
class Structure:
    """The composition of a planner, and the arrays that a structural change of its configuration replaces."""

    composition: Composition
    sizes: Sizes
    work: Workspace
    outputs: PackedArrays[PlannerOutputs]
    stages: Mapping[str, tuple[Any, Any]]
    """Arrays and outputs of each active stage by its name; None where it declares none."""

    @classmethod
    def allocate(
        cls, config: PlannerConfig, device: wp.Device, *, batch: int, workers: int, tuning: KernelTuning
    ) -> Structure:
        """Return the structure for a configuration, as before the first plan.

        Raises:
            MemoryError, RuntimeError: the device has no room for it.
        """
        composition = Composition.of(config)
        sizes = Sizes.from_config(config, composition, batch=batch, workers=workers, tuning=tuning)
        work = allocate(Workspace, sizes, device, noise=_noise_table(sizes.N, sizes.T, str(device)))
        reported = {stage.name: stage.outputs for stage in composition.stages if stage.outputs is not None}
        outputs = PackedArrays(PlannerOutputs, sizes, device, more=list(reported.values()))
        reports = dict(zip(reported, outputs.more, strict=True))
        stages = {
            stage.name: (
                None if stage.arrays is None else allocate(stage.arrays, sizes, device), reports.get(stage.name)
            )
            for stage in composition.stages
        }  # fmt: skip
        work.active.fill_(1)
        with wp.ScopedDevice(device):
            wp.launch(fill_directions, sizes.F, inputs=[sizes.F0, sizes.F1], outputs=[work.fine_directions])
        structure = cls(composition, sizes, work, outputs, stages)
        structure.forget("plans")
        structure.forget("sweeps")
        return structure

    @property
    def groups(self) -> tuple[Any, ...]:
        """Dataclasses of the arrays that may be kept from plan to plan: the workspace, then those of the stages."""
        return (self.work, *stage_groups(self.stages))

    def forget(self, kept: str) -> None:
        """Set the arrays that are kept for "plans" or for "sweeps" to their initial values."""
        for group in self.groups:
            forget(group, kept)


@functools.lru_cache(maxsize=4)
def _noise_table(steps: int, sequences: int, device: str) -> wp.array:
    """Return the table of noise, which all planners with as many steps share: to draw it takes 27 ms, on a CPU."""
    noise = wp.zeros((steps, 4, sequences), dtype=wp.float32, device=device)
    wp.launch(fill_noise, (steps, sequences), outputs=[noise], device=device)
    wp.synchronize_device(device)  # another planner may have a stream of its own
    return noise
