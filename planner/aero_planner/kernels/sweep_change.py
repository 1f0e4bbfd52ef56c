"""How the sweeps in memory change: a record that kernels read, so that one CUDA graph serves every sweep."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.device.records import CloudSweeps, Problem

wp.set_module_options({"enable_backward": False})

RECENT = wp.constant(8)
"""Newest sweeps that are looked at for motion."""

RecentRows: Any = wp.types.vector(length=RECENT, dtype=wp.int32)
"""Rows of the newest sweeps, newest first; -1 where there are fewer."""


@wp.struct
class SweepChange:
    """A sweep that arrives, one that is thinned, or both. Rows are -1 where there is none."""

    arrived: int  # row of the sweep that arrives
    thinned: int  # row of the sweep that is thinned
    recent: RecentRows  # sweeps to estimate the motion from
    time: wp.float64  # when the sweep was complete [s]; NaN: the time of the inputs
    position: wp.vec3  # position of the drone then, world frame [m]; NaN: that of the inputs


@wp.func
def changed_row(change: SweepChange, i: int) -> int:
    """Return the row of the sweep that arrives (i = 0) or is thinned (i = 1), whose points are to be ordered."""
    return wp.where(i == 0, change.arrived, change.thinned)


@wp.kernel
def stamp_sweep(
    change: wp.array(dtype=SweepChange),
    # problem
    problem: Problem,
    # out
    cloud: CloudSweeps,
):
    """Keep when and where the sweep that arrives was complete. Launched over [B]."""
    b = wp.tid()
    row = change[0].arrived
    if row < 0:
        return
    cloud.time[b, row] = wp.where(wp.isnan(change[0].time), problem.time[b], change[0].time)
    cloud.origin[b, row] = wp.where(wp.isnan(change[0].position[0]), problem.position[b], change[0].position)
