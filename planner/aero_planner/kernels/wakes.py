"""Wakes: places that moving obstacles have left since a sweep was measured, whose points no longer stand for anything.

The tracks of the sweeps that follow a sweep say where obstacles were when it was measured. They are laid on it, and the
partition leaves out its points there. A track counts only if all sweeps that it was made of are still in memory, so
that the wakes are a function of the sweeps in memory, however they got there.
"""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.kernels.params import Params
from aero_planner.kernels.records import CloudSweeps
from aero_planner.kernels.sweep_change import SweepChange
from aero_planner.kernels.sweep_numbers import is_confirmed, row_with_tracks

wp.set_module_options({"enable_backward": False})

WAKES = wp.constant(48)
"""Largest number of wakes of a sweep."""
_REACH = wp.constant(wp.float64(0.65))
"""Time after a sweep up to which tracks are laid on it [s]: as long as an obstacle is followed back."""
_SWEEP_TIME = wp.constant(0.1)
"""Time in which a sweep is measured, at most [s]."""
_MARGIN = wp.constant(0.15)
"""Distance from a moving obstacle up to which points belong to it [m]."""
_SAME = wp.constant(0.08)
"""Distance between two tracks of one obstacle, at most [m]."""


@wp.func
def forgets_wakes(params: Params) -> bool:
    """Return True if the points in wakes are left out."""
    return params.predict != 0 and params.speed_limit < params.predict_wake_speed


@wp.func
def add_wakes(b: int, sweep: int, row: int, before: int, cloud: CloudSweeps):
    """Lay the confirmed tracks that a later sweep shows on a sweep: one that is hidden may be where it was."""
    elapsed = float(cloud.time[b, row] - cloud.time[b, sweep])
    count = cloud.wake_count[b, sweep]
    for i in range(cloud.track_seen[b, row]):
        velocity = cloud.track_velocity[b, row, i]
        position = cloud.track_position[b, row, i] - elapsed * velocity
        radius = cloud.track_radius[b, row, i] + _MARGIN
        is_new = count < WAKES and is_confirmed(b, row, i, before, cloud)
        for k in range(count):
            is_near = wp.length(cloud.wake_position[b, sweep, k] - position) < _SAME
            if is_near and wp.abs(cloud.wake_radius[b, sweep, k] - radius) < _SAME:
                is_new = False
        if is_new:
            cloud.wake_position[b, sweep, count] = position
            cloud.wake_velocity[b, sweep, count] = velocity
            cloud.wake_radius[b, sweep, count] = radius
            count += 1
    cloud.wake_count[b, sweep] = count


@wp.kernel
def find_wakes(
    change: wp.array(dtype=SweepChange),
    # configuration
    params: wp.array(dtype=Params),
    # in and out
    cloud: CloudSweeps,
):
    """Find the wakes of all sweeps in memory. Launched over [B, S].

    The oldest sweeps, which only tracks that do not count would tell about, take those of the first one that counts.
    """
    b, sweep = wp.tid()
    cloud.wake_count[b, sweep] = 0
    oldest = change[0].oldest
    newest = change[0].number
    number = cloud.number[sweep]
    if number < oldest or number >= newest or not forgets_wakes(params[b]):
        return
    is_first = bool(True)
    for later in range(oldest, newest + 1):
        row = row_with_tracks(later, oldest, cloud)
        before = row_with_tracks(later - 1, oldest, cloud)
        if row >= 0 and before >= 0:
            elapsed = cloud.time[b, row] - cloud.time[b, sweep]
            # False without stamps.
            if elapsed > wp.float64(0.0) and (elapsed < _REACH or is_first):
                add_wakes(b, sweep, row, before, cloud)
            is_first = False


@wp.func
def is_in_wake(point: wp.vec3, b: int, sweep: int, count: int, cloud: CloudSweeps) -> bool:
    """Return True for a point of a sweep that belongs to an obstacle which has moved on. `count` is the sweep's."""
    for i in range(count):
        end = cloud.wake_position[b, sweep, i]
        path = _SWEEP_TIME * cloud.wake_velocity[b, sweep, i]
        offset = wp.vec2(point[0], point[1]) - end + path
        # The obstacle went from `end - path` to `end` while the sweep was measured.
        along = wp.clamp(wp.dot(offset, path) / wp.dot(path, path), 0.0, 1.0)
        if wp.length(offset - along * path) < cloud.wake_radius[b, sweep, i]:
            return True
    return False
