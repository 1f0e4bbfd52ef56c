"""The stage that removes stray points from sweeps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import warp as wp

from aero_planner.array_memory import array
from aero_planner.recorder import Recorder
from aero_planner.stage import Launches, Stage
from aero_planner.stages.stray_points import support
from aero_planner.stages.stray_points.support import LISTED, SIDE, SWEEPS

_NAME = "stray_points"
_SWEEPS, _LISTED, _VOXELS = int(SWEEPS), int(LISTED), int(SIDE) ** 3


@dataclass(eq=False)
class Arrays:
    """Near points of the newest sweeps, and their grid."""

    near_slot: wp.array = array(wp.int32, "B", "", "List of the newest sweep.", kept="sweeps")
    near_time: wp.array = array(wp.float64, "B", "s", "When it arrived.", kept="sweeps", initial=math.nan)
    near_count: wp.array = array(wp.int32, f"B {_SWEEPS}", "", "Near points of each sweep.", kept="sweeps")
    near_points: wp.array = array(wp.vec3, f"B {_SWEEPS} {_LISTED}", "m", "Near points of each sweep, world frame.")
    near_grid: wp.array = array(wp.int32, f"B 2 {_VOXELS}", "", "Support by each voxel around the drone.")


def _remove(r: Recorder) -> list[list[Launches]]:
    """Remove the stray points of the sweep that arrives."""
    a, B, threads = r.stage_arrays(_NAME), r.sizes.B, r.threads_per_sweep
    near = r.bind(support.NearPoints, _NAME)
    sources, sweeps = [threads, r.change], r.arrays.cloud.start.shape[0]
    return [[[
        a.near_grid.zero_,
        r.record(support.begin_list, (B,), inputs=[r.change, r.sweeps], outputs=[near]),
        r.record(support.list_near, (B, threads), inputs=[*sources, r.sweeps], outputs=[near]),
        r.record(support.count_voxels, (B, _SWEEPS, threads), inputs=[*sources, r.sweeps], outputs=[near]),
        r.record(support.count_far, (B, sweeps, threads), inputs=[*sources, r.sweeps], outputs=[near]),
        r.record(support.remove_stray, (B, threads), inputs=[*sources, near], outputs=[r.sweeps]),
    ]]]  # fmt: skip


STAGE = Stage(name=_NAME, label="Stray points", arrays=Arrays, launches={"arrival": _remove})
