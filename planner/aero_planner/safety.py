"""The planner's judgement of its instances: which of them may be flown, and why the others may not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.device.records import bundle
from aero_planner.kernels.judgement import Judgement, judges, write_judgement
from aero_planner.recorder import Recorder


@dataclass(frozen=True, eq=False)
class Safety:
    """How M instances of N steps were judged in the last plan."""

    clearance: NDArray[np.float32]
    """Clearance after each control as it counts [m], shape [M, N]: less the margin for the speed, truncated where it is
    enough, and with an allowance for dynamic obstacles that are near at the start."""
    demanded_clearance: float
    """Clearance that is demanded of every state [m]."""
    keeps_clearance: NDArray[np.bool_]
    """True for each instance with that clearance, shape [M]."""
    is_admissible: NDArray[np.bool_]
    """True for each instance that may be flown, by its clearance and the stages that judge, shape [M]."""
    refused_by: Mapping[str, NDArray[np.bool_]]
    """True for each instance that a stage refuses whatever its clearance, shape [M], by the name of the stage."""
    replaced: int | None
    """Instance whose rollout was replaced by one that stops; None if there is none."""

    @property
    def is_safe(self) -> NDArray[np.bool_]:
        """`is_admissible` without the instance that was replaced, shape [M]: the plan no longer has its rollout."""
        is_safe = self.is_admissible.copy()
        if self.replaced is not None:
            is_safe[self.replaced] = False
        return is_safe


def judge_instances(recorder: Recorder) -> Safety:
    """Return how the instances of the first drone were judged in the last plan of these arrays."""
    r, device = recorder, recorder.params.device
    stages, M, N = judges(r.composition), r.sizes.M, r.sizes.N
    with wp.ScopedDevice(device):
        judgement = bundle(
            Judgement,
            clearance=wp.zeros((M, N), dtype=wp.float32),
            demanded=wp.zeros(M, dtype=wp.float32),
            is_admissible=wp.zeros((M, 2 + len(stages)), dtype=wp.int32),
        )
        kernel = write_judgement(r.tuning, r.composition)
        wp.launch(kernel, M, inputs=[0, r.params, r.views, r.scores], outputs=[judgement])
    admissible = judgement.is_admissible.numpy() != 0
    replaced = int(r.outputs.braking_instance.numpy()[0])
    return Safety(
        clearance=judgement.clearance.numpy(),
        demanded_clearance=float(judgement.demanded.numpy()[0]),
        keeps_clearance=admissible[:, 0],
        is_admissible=admissible[:, 1],
        refused_by={stage.name: ~admissible[:, 2 + i] for i, stage in enumerate(stages)},
        replaced=replaced if replaced >= 0 else None,
    )
