"""The record from which kernels read how the sweeps in memory change, so that one CUDA graph serves every sweep."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

RECENT = wp.constant(8)
"""Newest sweeps that are looked at for motion."""

RecentRows: Any = wp.types.vector(length=RECENT, dtype=wp.int32)
"""Rows of the newest sweeps, newest first; -1 where there are fewer."""


@wp.struct
class SweepChange:
    """A sweep that arrives, one that is thinned, or both. Rows are -1 where there is none."""

    arrived: int  # row of the sweep that arrives
    number: int  # number of the newest sweep, in the order of arrival
    oldest: int  # number of the oldest sweep in memory
    thinned: int  # row of the sweep that is thinned
    recent: RecentRows  # sweeps to estimate the motion from
    time: wp.float64  # when the sweep was complete [s]; NaN: the time of the inputs
    position: wp.vec3  # position of the drone then, world frame [m]; NaN: that of the inputs


@wp.func
def changed_row(change: SweepChange, i: int) -> int:
    """Return the row of the sweep that arrives (i = 0) or is thinned (i = 1), whose points are to be ordered."""
    return wp.where(i == 0, change.arrived, change.thinned)
