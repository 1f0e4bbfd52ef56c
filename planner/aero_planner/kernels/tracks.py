"""Velocities of obstacles, from the circles of the newest sweeps.

A circle that older sweeps show as well, displaced in proportion to their age, moves, unless the scans show that its
places were occupied all along: the visible part of an inclined trunk creeps while the drone flies by.
"""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.kernels.motion import BIN_ANGLE, BINS, Segments, origin_of_scan, range_of_bin
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import CloudSweeps
from aero_planner.kernels.sweep_change import RECENT, RecentRows, SweepChange
from aero_planner.kernels.sweep_numbers import is_confirmed, row_with_tracks

wp.set_module_options({"enable_backward": False})

STARTS = wp.constant(3)
"""Newest sweeps of which obstacles are followed back."""
LENGTH = wp.constant(6)
"""Sweeps through which an obstacle is followed back."""
_SPEED_MAX = wp.constant(4.0)
"""Largest speed that is looked for [m/s]."""
_GATE = wp.constant(0.25)
"""Distance from where a segment is expected, at most [m]."""
_SAME_RADIUS = wp.constant(0.2)
"""Difference between the radii of a segment in two sweeps, at most [m]."""
_LEAST_MATCHES = wp.constant(3)
"""Older sweeps that show the segment, at least."""
_MEMORY = wp.constant(1.0)
"""Time for which an obstacle goes on after a sweep has shown its motion for the last time [s]."""
_MEMORY_SWEEPS = wp.constant(32)
"""Number of sweeps in that time, at most."""
_RESIDUAL = wp.constant(0.07)
"""Root mean square distance from uniform motion, at most [m]."""
_LEAST_DEVIATION = wp.constant(0.025)
"""Standard deviation of the position of a circle, at least [m]."""
_SIGNIFICANCE = wp.constant(8.0)
"""Ratio of the speed to its standard deviation, at least: hidden edges make standing obstacles creep."""


@wp.struct
class FoundTracks:
    """Segments that move, by the sweep in which they were last seen; X is `MOVERS`."""

    position: wp.array3d(dtype=wp.vec2)  # [B, STARTS, X], axis when the newest sweep arrived, world frame [m]
    velocity: wp.array3d(dtype=wp.vec2)  # [B, STARTS, X], world frame [m/s]
    radius: wp.array3d(dtype=float)  # [B, STARTS, X], [m]; -1 for none


@wp.func
def nearest_segment(b: int, recent: int, center: wp.vec2, radius: float, gate: float, segments: Segments) -> int:
    """Return the segment of a sweep that is nearest to where a segment is expected; -1 if there is none."""
    nearest = int(-1)
    smallest = gate
    for j in range(segments.count[b, recent]):
        distance = wp.length(segments.center[b, recent, j] - center)
        if distance < smallest and wp.abs(segments.radius[b, recent, j] - radius) < _SAME_RADIUS:
            smallest = distance
            nearest = j
    return nearest


@wp.func
def bins_of_disk(position: wp.vec2, radius: float, origin: wp.vec3) -> wp.vec2i:
    """Return the middle bin toward a disk, and the number of bins from there to its edge."""
    offset = position - wp.vec2(origin[0], origin[1])
    middle = (wp.atan2(offset[1], offset[0]) / (2.0 * wp.PI) + 0.5) * float(BINS)
    half = wp.asin(radius / wp.max(wp.length(offset), radius + 1.0e-3)) / BIN_ANGLE
    return wp.vec2i(int(middle), int(half))


@wp.func
def count_bins(
    b: int,
    recent: int,
    position: wp.vec2,
    radius: float,
    other: wp.vec2,
    other_radius: float,
    origin: wp.vec3,
    scan: wp.array3d(dtype=int),
) -> wp.vec4i:
    """Return the numbers of bins toward a disk that show something behind it, at it, before it, and nothing.

    Bins that another disk covers do not count. A negative `other_radius` means no other disk.
    """
    disk = bins_of_disk(position, radius, origin)
    other_disk = bins_of_disk(other, wp.max(other_radius, 0.0), origin)
    covered = wp.where(other_radius < 0.0, -1, other_disk[1] + 1)
    distance = wp.length(position - wp.vec2(origin[0], origin[1]))
    counts = wp.vec4i(0, 0, 0, 0)
    for k in range(disk[0] - disk[1], disk[0] + disk[1] + 1):
        apart = wp.abs((k - other_disk[0] + BINS + BINS // 2) % BINS - BINS // 2)
        if apart > covered:
            r = range_of_bin(scan, b, recent, k)
            if r == 0.0:
                counts[3] += 1
            elif r > distance + _GATE:
                counts[0] += 1
            elif r >= distance - radius - _GATE:
                counts[1] += 1
            else:
                counts[2] += 1
    return counts


@wp.func
def has_moved(
    b: int,
    begin: int,
    oldest: int,
    newest_place: wp.vec2,
    oldest_place: wp.vec2,
    radius: float,
    rows: RecentRows,
    cloud: CloudSweeps,
    scan: wp.array3d(dtype=int),
) -> bool:
    """Return True if the scans agree that a segment has moved.

    More bins must look through its oldest place later, and through its newest place earlier, than show something there.
    Where none looks at either place alone, it moves along the line of sight, and nothing speaks against it.
    """
    later = count_bins(
        b, begin, oldest_place, radius, newest_place, radius, origin_of_scan(b, begin, rows, cloud), scan
    )
    earlier = count_bins(
        b, oldest, newest_place, radius, oldest_place, radius, origin_of_scan(b, oldest, rows, cloud), scan
    )
    counts = later + earlier
    through = counts[0] + counts[3]
    return through > counts[1] or through + counts[1] + counts[2] == 0


@wp.kernel
def follow_segments(
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # in
    scan: wp.array3d(dtype=int),
    segments: Segments,
    # out
    found: FoundTracks,
):
    """Follow each segment of the newest sweeps back through older ones, and fit a uniform motion.

    A segment moves if its speed exceeds `_SIGNIFICANCE` times its standard deviation and `has_moved` agrees. Segments
    of the `STARTS` newest sweeps are followed, since an obstacle may be hidden for a while.
    Launched over [B, STARTS, MOVERS].
    """
    b, begin, i = wp.tid()
    found.radius[b, begin, i] = -1.0
    rows = change[0].recent
    if rows[begin] < 0 or params[b].predict == 0:
        return
    if i >= segments.count[b, begin]:
        return
    newest = cloud.time[b, rows[0]]
    begin_time = cloud.time[b, rows[begin]]
    start = segments.center[b, begin, i]
    radius = segments.radius[b, begin, i]
    # Sums over the matches: number, time, time^2, displacement, displacement * time, displacement^2, radius.
    n = float(1.0)
    sum_t = float(0.0)
    sum_tt = float(0.0)
    sum_x = wp.vec2(0.0, 0.0)
    sum_xt = wp.vec2(0.0, 0.0)
    sum_xx = float(0.0)
    sum_radius = radius
    spread = float(0.0)
    velocity = wp.vec2(0.0, 0.0)
    period = float(0.0)
    oldest = int(begin)
    oldest_time = float(0.0)
    for recent in range(begin + 1, begin + LENGTH):
        if rows[recent] >= 0:
            t = float(cloud.time[b, rows[recent]] - begin_time)
            if recent == begin + 1:
                period = -t
            if t < 0.0:
                gate = wp.where(n == 1.0, _GATE - _SPEED_MAX * t, _GATE)
                j = nearest_segment(b, recent, start + t * velocity, radius, gate, segments)
                if j >= 0:
                    x = segments.center[b, recent, j] - start
                    oldest = recent
                    oldest_time = t
                    n += 1.0
                    sum_t += t
                    sum_tt += t * t
                    sum_x += x
                    sum_xt += t * x
                    sum_xx += wp.dot(x, x)
                    sum_radius += segments.radius[b, recent, j]
                    spread = sum_tt - sum_t * sum_t / n
                    velocity = (sum_xt - sum_t * sum_x / n) / spread
    speed = wp.length(velocity)
    if n < float(_LEAST_MATCHES + 1) or speed < params[b].predict_speed or speed > _SPEED_MAX:
        return
    offset = (sum_x - sum_t * velocity) / n
    # Mean squared distance from the line: sum |x - offset - t velocity|^2 / n.
    variance = (sum_xx - wp.dot(offset, sum_x) - wp.dot(velocity, sum_xt)) / n
    variance = wp.max(variance, _LEAST_DEVIATION * _LEAST_DEVIATION)
    if variance > _RESIDUAL * _RESIDUAL or speed * speed * spread < _SIGNIFICANCE * _SIGNIFICANCE * variance:
        return
    place = start + offset
    if not has_moved(b, begin, oldest, place, place + oldest_time * velocity, sum_radius / n, rows, cloud, scan):
        return
    # A sweep shows the obstacle as it was in the middle of it.
    elapsed = 0.5 * period + float(newest - begin_time)
    found.position[b, begin, i] = place + elapsed * velocity
    found.velocity[b, begin, i] = velocity
    found.radius[b, begin, i] = sum_radius / n


@wp.func
def is_blocked(b: int, position: wp.vec2, radius: float, origin: wp.vec3, scan: wp.array3d(dtype=int)) -> bool:
    """Return False if the newest scan shows free space, or nothing, where an obstacle is expected."""
    if wp.length(position - wp.vec2(origin[0], origin[1])) <= radius:
        return True
    counts = count_bins(b, 0, position, radius, position, -1.0, origin, scan)
    return counts[1] + counts[2] > counts[0]


@wp.func
def add_track(b: int, row: int, position: wp.vec2, velocity: wp.vec2, radius: float, known: int, cloud: CloudSweeps):
    """Add a track to those of a row, unless one of the first `known` is the same obstacle or there is no room."""
    count = cloud.track_count[b, row]
    is_new = count < MOVERS
    for k in range(known):
        if wp.length(cloud.track_position[b, row, k] - position) < cloud.track_radius[b, row, k] + _GATE:
            is_new = False
    if is_new:
        cloud.track_position[b, row, count] = position
        cloud.track_velocity[b, row, count] = velocity
        cloud.track_radius[b, row, count] = radius
        cloud.track_count[b, row] = count + 1


@wp.kernel
def merge_tracks(
    change: wp.array(dtype=SweepChange),
    # configuration
    params: wp.array(dtype=Params),
    # in
    scan: wp.array3d(dtype=int),
    found: FoundTracks,
    # out
    newest: wp.array(dtype=int),
    cloud: CloudSweeps,
):
    """List what was found in the newest sweep, then what was last found in older ones. Launched over [B].

    An obstacle that two sweeps of the last `_MEMORY` seconds showed goes on at its velocity, unless the newest scan
    shows that it is not there. As in `kernels.wakes`, tracks are used only while all sweeps that they were made of are
    in memory.
    """
    b = wp.tid()
    rows = change[0].recent
    oldest = change[0].oldest
    row = rows[0]
    if row < 0:
        return
    if b == 0:
        newest[0] = row
        last = rows[RECENT - 1]
        cloud.tracked_from[row] = -1
        if last >= 0:
            cloud.tracked_from[row] = cloud.number[last]
    cloud.track_count[b, row] = 0
    for begin in range(STARTS):
        known = cloud.track_count[b, row]
        for i in range(MOVERS):
            radius = found.radius[b, begin, i]
            if radius >= 0.0:
                add_track(b, row, found.position[b, begin, i], found.velocity[b, begin, i], radius, known, cloud)
        if begin == 0:
            cloud.track_seen[b, row] = cloud.track_count[b, row]
    if params[b].predict_memory == 0:
        return
    origin = origin_of_scan(b, 0, rows, cloud)
    number = cloud.number[row]
    elapsed = float(0.0)
    back = int(1)
    earlier = row_with_tracks(number - 1, oldest, cloud)
    while back <= _MEMORY_SWEEPS and not elapsed >= _MEMORY:  # NaN without stamps
        before = row_with_tracks(number - back - 1, oldest, cloud)
        if earlier >= 0:
            elapsed = float(cloud.time[b, row] - cloud.time[b, earlier])
        if earlier >= 0 and before >= 0 and elapsed > 0.0 and elapsed < _MEMORY:
            known = cloud.track_count[b, row]
            for i in range(cloud.track_seen[b, earlier]):
                velocity = cloud.track_velocity[b, earlier, i]
                position = cloud.track_position[b, earlier, i] + elapsed * velocity
                radius = cloud.track_radius[b, earlier, i]
                is_moving = is_confirmed(b, earlier, i, before, cloud)
                if is_moving and is_blocked(b, position, radius, origin, scan):
                    add_track(b, row, position, velocity, radius, known, cloud)
        earlier = before
        back += 1
