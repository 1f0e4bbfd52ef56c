"""How the selection judges each instance, for explanations: its own functions, one by one."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Scores
from aero_planner.kernels.selection import admissible, dynamic_allowance, safe_clearance
from aero_planner.stage import Stage

wp.set_module_options({"enable_backward": False})


@wp.struct
class Judgement:
    """What the selection finds of M instances."""

    clearance: wp.array2d(dtype=float)  # [M, N], of each state as it counts [m]
    demanded: wp.array(dtype=float)  # [M], demanded of all states [m]
    # [M, 2 + judges]: 1 if it may be flown by its clearance, if all judge, and if a stage judges one that may be so far
    is_admissible: wp.array2d(dtype=int)


def judges(composition: Composition) -> tuple[Stage, ...]:
    """Return the stages that judge whether an instance may be flown, in the order in which they do."""
    return tuple(stage for stage in composition.stages if stage.hooks.admissible is not None)


@functools.cache
def write_judgement(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that writes how each instance of a drone is judged."""
    Views, is_admissible = composition.Views, admissible(composition)
    write_stages = _write_stages(judges(composition))

    @wp.kernel(module="unique", enable_backward=False)
    def write_judgement(
        # problem
        b: int,
        # configuration
        params: wp.array(dtype=Params),
        # in
        views: Views,
        scores: Scores,
        # out
        judgement: Judgement,
    ):
        """Write the judgement of drone b. Launched over [M]."""
        m = wp.tid()
        c = params[b]
        safe = safe_clearance(scores.static_clearance[b, 0, scores.static_clearance.shape[2] - 1], c)
        allowance = dynamic_allowance(b, m, scores, c)
        for t in range(judgement.clearance.shape[1]):
            judgement.clearance[m, t] = wp.min(
                scores.state_clearance[b, m, t] + allowance, scores.static_clearance[b, m, t]
            )
        judgement.demanded[m] = safe
        judgement.is_admissible[m, 0] = wp.where(scores.least_clearance[b, m][0] >= safe, 1, 0)
        judgement.is_admissible[m, 1] = is_admissible(b, m, safe, scores, views, c)
        write_stages(b, m, views, c, judgement.is_admissible)

    return tuning.set_options(write_judgement)


def _write_stages(stages: tuple[Stage, ...]) -> wp.Function:
    """Return the function (b, m, views, c, is_admissible) that writes the judgement of each stage alone."""
    write: Any = _nothing
    for i, stage in enumerate(stages):
        write = _then(write, stage.hooks.admissible, i)
    return write


@wp.func
def _nothing(b: int, m: int, views: Any, c: Any, is_admissible: wp.array2d(dtype=int)):
    pass


def _then(first: Any, judge: Any, index: int) -> Any:
    INDEX = wp.constant(index)

    @wp.func
    def then(b: int, m: int, views: Any, c: Any, is_admissible: wp.array2d(dtype=int)):
        first(b, m, views, c, is_admissible)
        is_admissible[m, INDEX + 2] = judge(b, m, 1, views, c)

    return then
