"""Sweeps by their number in the order of arrival."""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.kernels.records import CloudSweeps

wp.set_module_options({"enable_backward": False})


@wp.func
def row_with_tracks(number: int, oldest: int, cloud: CloudSweeps) -> int:
    """Return the row of a sweep, or -1 if a sweep that its tracks were made of has left the memory."""
    found = int(-1)
    for row in range(cloud.number.shape[0]):
        if cloud.number[row] == number and cloud.tracked_from[row] >= oldest:
            found = row
    return found
