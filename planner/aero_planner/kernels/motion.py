"""Velocities of obstacles, from the newest sweeps.

Each sweep becomes a horizontal scan: the nearest range of the points near the drone's height, by azimuth around the
place where the sweep was measured. Neighbouring bins of similar range form a segment, and a circle is laid through each
segment that nothing hides. A circle that the older sweeps show as well, displaced in proportion to their age, moves.

All sweeps are cut at the height at which the newest one arrived, so that the section of an inclined trunk stands still
while the drone climbs.
"""

# Postponed annotations are left out: the vector type is local to the module.

from typing import Any

import warp as wp

from aero_planner.kernels.dynamics import near_atan2
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import CloudSweeps
from aero_planner.kernels.sweep_numbers import row_with_tracks

wp.set_module_options({"enable_backward": False})

STARTS = wp.constant(3)
"""Newest sweeps of which obstacles are followed back."""
LENGTH = wp.constant(6)
"""Sweeps through which an obstacle is followed back."""
RECENT = wp.constant(8)
"""Newest sweeps that are looked at."""
BINS = wp.constant(720)
"""Bins of a scan around the horizon."""
_BIN_ANGLE = wp.constant(2.0 * 3.14159265 / 720.0)
_BELOW = wp.constant(0.6)
"""Reach of the scan below the drone [m]."""
_ABOVE = wp.constant(1.5)
"""Reach of the scan above the drone [m]: a tilted sensor does not see what is level with it."""
_ABOVE_GROUND = wp.constant(0.3)
"""Least height of a point of the scan above the ground [m]."""
_JUMP = wp.constant(0.3)
"""Difference in range between neighbouring bins that ends a segment [m]."""
_GAP = wp.constant(2)
"""Bins from one point of a segment to the next, at most."""
_LEAST_BINS = wp.constant(3)
"""Bins of a segment, at least."""
_LARGEST_SINE = wp.constant(0.7)
"""Sine of half the angle of a segment, at most: nearer obstacles are too large for a circle."""
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
_MEMORY_SWEEPS = wp.constant(12)
"""Number of sweeps in that time, at most."""
_RESIDUAL = wp.constant(0.07)
"""Root mean square distance from uniform motion, at most [m]."""
_LEAST_DEVIATION = wp.constant(0.025)
"""Standard deviation of the position of a circle, at least [m]."""
_SIGNIFICANCE = wp.constant(8.0)
"""Ratio of the speed to its standard deviation, at least: hidden edges make standing obstacles creep."""
_NEAREST = wp.constant(0x7F000000)
"""Entry of a scan for the range 0; it falls with the range, and is 0 for an empty bin."""

RecentRows: Any = wp.types.vector(length=RECENT, dtype=wp.int32)
"""Rows of the newest sweeps, newest first; -1 where there are fewer."""


@wp.struct
class Segments:
    """Circles of the segments of each recent sweep; X is `MOVERS`."""

    count: wp.array2d(dtype=int)  # [B, RECENT]
    center: wp.array3d(dtype=wp.vec2)  # [B, RECENT, X], world frame [m]
    radius: wp.array3d(dtype=float)  # [B, RECENT, X], [m]


@wp.struct
class FoundTracks:
    """Segments that move, by the sweep in which they were last seen; X is `MOVERS`."""

    position: wp.array3d(dtype=wp.vec2)  # [B, STARTS, X], axis when the newest sweep arrived, world frame [m]
    velocity: wp.array3d(dtype=wp.vec2)  # [B, STARTS, X], world frame [m/s]
    radius: wp.array3d(dtype=float)  # [B, STARTS, X], [m]; -1 for none


@wp.kernel
def stamp_sweep(
    row: int,
    number: int,
    given_time: wp.float64,
    given_position: wp.vec3,
    time: wp.array(dtype=wp.float64),
    position: wp.array(dtype=wp.vec3),
    # out
    cloud: CloudSweeps,
):
    """Keep when and where a sweep was complete: what is given, or the inputs where that is NaN. Launched over [B]."""
    b = wp.tid()
    if b == 0:
        cloud.number[row] = number
        cloud.tracked_from[row] = -1
    cloud.time[b, row] = wp.where(wp.isnan(given_time), time[b], given_time)
    cloud.origin[b, row] = wp.where(wp.isnan(given_position[0]), position[b], given_position)


@wp.func
def origin_of_scan(b: int, recent: int, rows: RecentRows, cloud: CloudSweeps) -> wp.vec3:
    """Return the position in the middle of a sweep: between those at which it and the sweep before it arrived."""
    origin = cloud.origin[b, rows[recent]]
    before = rows[wp.min(recent + 1, RECENT - 1)]
    if before >= 0:
        origin = 0.5 * (origin + cloud.origin[b, before])
    return origin


@wp.kernel
def scan_obstacles(
    rows: RecentRows,
    # problem
    cloud: CloudSweeps,
    ground_height: wp.array(dtype=float),
    # configuration
    params: wp.array(dtype=Params),
    # out
    scan: wp.array3d(dtype=int),
):
    """Find the nearest range of each bin of the recent sweeps. Launched over [B, RECENT, points of a sweep]."""
    b, recent, i = wp.tid()
    row = rows[recent]
    if row < 0 or params[b].predict == 0:
        return
    if i >= cloud.count[b, row]:
        return
    point = cloud.points[b, cloud.start[row] + i]
    # False for a point that is not finite.
    height = point[2] - cloud.origin[b, rows[0]][2]
    if height >= -_BELOW and height <= _ABOVE and point[2] >= ground_height[b] + _ABOVE_GROUND:
        offset = point - origin_of_scan(b, recent, rows, cloud)
        r = wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
        if r > params[b].range_min and r <= params[b].predict_range:
            k = int((near_atan2(offset[1], offset[0]) / (2.0 * wp.PI) + 0.5) * float(BINS)) % BINS
            # The bits of positive floats have the order of the floats.
            wp.atomic_max(scan, b, recent, k, _NEAREST - wp.cast(r, wp.int32))


@wp.func
def range_of_bin(scan: wp.array3d(dtype=int), b: int, recent: int, k: int) -> float:
    """Return the range of a bin, whose number may be beyond the last one; 0 for an empty bin."""
    entry = scan[b, recent, (k + BINS) % BINS]
    return wp.where(entry == 0, 0.0, wp.cast(_NEAREST - entry, float))


@wp.func
def add_segment(
    b: int,
    recent: int,
    first: int,
    last: int,
    origin: wp.vec3,
    width_max: float,
    scan: wp.array3d(dtype=int),
    segments: Segments,
):
    """Add the circle of a segment from bin `first` to bin `last`, unless it is too small or too large."""
    bins = last - first + 1
    sine = wp.sin(0.5 * (float(bins) - 0.5) * _BIN_ANGLE)
    slot = segments.count[b, recent]
    if bins < _LEAST_BINS or bins > BINS // 3 or sine > _LARGEST_SINE or slot == MOVERS:
        return
    total = float(0.0)
    found = float(0.0)
    for k in range(first + bins // 3, last - bins // 3 + 1):
        r = range_of_bin(scan, b, recent, k)
        if r > 0.0:
            total += r
            found += 1.0
    if found == 0.0:
        return
    front = total / found
    radius = front * sine / (1.0 - sine)
    if 2.0 * radius > width_max:
        return
    angle = 0.5 * float(first + last + 1) * _BIN_ANGLE - wp.PI
    center = wp.vec2(origin[0], origin[1]) + (front + radius) * wp.vec2(wp.cos(angle), wp.sin(angle))
    segments.center[b, recent, slot] = center
    segments.radius[b, recent, slot] = radius
    segments.count[b, recent] = slot + 1


@wp.kernel
def find_segments(
    rows: RecentRows,
    # problem
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # in
    scan: wp.array3d(dtype=int),
    # out
    segments: Segments,
):
    """Find the circles of the segments that nothing hides at either end. Launched over [B, RECENT]."""
    b, recent = wp.tid()
    segments.count[b, recent] = 0
    if rows[recent] < 0 or params[b].predict == 0:
        return
    width_max = params[b].predict_width
    origin = origin_of_scan(b, recent, rows, cloud)
    # Begin where no segment continues.
    begin = int(-1)
    for k in range(BINS):
        if begin < 0:
            r = range_of_bin(scan, b, recent, k)
            before = range_of_bin(scan, b, recent, k - 1)
            if (r == 0.0 and before == 0.0) or (r > 0.0 and before > 0.0 and wp.abs(r - before) > _JUMP):
                begin = k
    if begin < 0:
        return
    first = int(-1)
    last = begin - 1
    last_range = range_of_bin(scan, b, recent, last)
    hidden = bool(False)
    for k in range(begin, begin + BINS + 1):
        r = range_of_bin(scan, b, recent, k)
        if r > 0.0:
            is_near = last_range > 0.0 and k - last <= _GAP
            if first >= 0 and (not is_near or wp.abs(r - last_range) > _JUMP):
                if not hidden and not (is_near and r < last_range):
                    add_segment(b, recent, first, last, origin, width_max, scan, segments)
                first = -1
            if first < 0:
                first = k
                hidden = is_near and last_range < r
            last = k
            last_range = r
    if first >= 0 and not hidden and last < begin + BINS:
        add_segment(b, recent, first, last, origin, width_max, scan, segments)


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


@wp.kernel
def follow_segments(
    rows: RecentRows,
    # problem
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # in
    segments: Segments,
    # out
    found: FoundTracks,
):
    """Follow each segment of the newest sweeps back through older ones, and fit a uniform motion.

    A segment moves if its speed exceeds `_SIGNIFICANCE` times its standard deviation. Segments of the `STARTS` newest
    sweeps are followed, since an obstacle may be hidden for a while. Launched over [B, STARTS, MOVERS].
    """
    b, begin, i = wp.tid()
    found.radius[b, begin, i] = -1.0
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
    # A sweep shows the obstacle as it was in the middle of it.
    elapsed = 0.5 * period + float(newest - begin_time)
    found.position[b, begin, i] = start + offset + elapsed * velocity
    found.velocity[b, begin, i] = velocity
    found.radius[b, begin, i] = sum_radius / n


@wp.func
def is_blocked(b: int, position: wp.vec2, radius: float, origin: wp.vec3, scan: wp.array3d(dtype=int)) -> bool:
    """Return False if the newest scan shows free space, or nothing, where an obstacle is expected."""
    offset = position - wp.vec2(origin[0], origin[1])
    distance = wp.length(offset)
    if distance <= radius:
        return True
    middle = int((wp.atan2(offset[1], offset[0]) / (2.0 * wp.PI) + 0.5) * float(BINS))
    half = int(wp.asin(radius / distance) / _BIN_ANGLE)
    through = int(0)
    blocked = int(0)
    for k in range(middle - half, middle + half + 1):
        r = range_of_bin(scan, b, 0, k)
        if r > distance + _GATE:
            through += 1
        elif r > 0.0:
            blocked += 1
    return blocked > through


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
    rows: RecentRows,
    oldest: int,
    # in
    scan: wp.array3d(dtype=int),
    found: FoundTracks,
    # out
    newest: wp.array(dtype=int),
    cloud: CloudSweeps,
):
    """List what was found in the newest sweep, then what was last found in older ones. Launched over [B].

    An obstacle that a sweep of the last `_MEMORY` seconds showed goes on at its velocity, unless the newest scan shows
    that it is not there. `oldest` is the number of the oldest sweep in memory: as in `kernels.wakes`, tracks are used
    only while all sweeps that they were made of are.
    """
    b = wp.tid()
    row = rows[0]
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
    origin = origin_of_scan(b, 0, rows, cloud)
    number = cloud.number[row]
    for back in range(1, _MEMORY_SWEEPS + 1):
        earlier = row_with_tracks(number - back, oldest, cloud)
        if earlier >= 0:
            elapsed = float(cloud.time[b, row] - cloud.time[b, earlier])
            # False without stamps.
            if elapsed > 0.0 and elapsed < _MEMORY:
                known = cloud.track_count[b, row]
                for i in range(cloud.track_seen[b, earlier]):
                    velocity = cloud.track_velocity[b, earlier, i]
                    position = cloud.track_position[b, earlier, i] + elapsed * velocity
                    radius = cloud.track_radius[b, earlier, i]
                    if is_blocked(b, position, radius, origin, scan):
                        add_track(b, row, position, velocity, radius, known, cloud)
