"""Sweeps by their number in the order of arrival, and tracks that two of them show."""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.kernels.records import CloudSweeps

wp.set_module_options({"enable_backward": False})

_GATE = wp.constant(0.25)
"""Distance between the places at which two sweeps expect an obstacle, at most [m]."""
_SAME_VELOCITY = wp.constant(0.4)
"""Difference between its velocities, at most [m/s]."""


@wp.func
def row_with_tracks(number: int, oldest: int, cloud: CloudSweeps) -> int:
    """Return the row of a sweep, or -1 if a sweep that its tracks were made of has left the memory."""
    found = int(-1)
    for row in range(cloud.number.shape[0]):
        if cloud.number[row] == number and cloud.tracked_from[row] >= oldest:
            found = row
    return found


@wp.func
def is_confirmed(b: int, row: int, i: int, before: int, cloud: CloudSweeps) -> bool:
    """Return True if the sweep before shows the motion of a track, too: edges of standing obstacles creep at times."""
    elapsed = float(cloud.time[b, row] - cloud.time[b, before])
    for k in range(cloud.track_seen[b, before]):
        velocity = cloud.track_velocity[b, before, k]
        offset = cloud.track_position[b, before, k] + elapsed * velocity - cloud.track_position[b, row, i]
        change = velocity - cloud.track_velocity[b, row, i]
        if wp.length(offset) < _GATE and wp.length(change) < _SAME_VELOCITY:
            return True
    return False
