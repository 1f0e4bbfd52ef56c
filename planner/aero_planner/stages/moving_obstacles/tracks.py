"""Velocities of obstacles, from the circles of the newest sweeps.

A circle that older sweeps show as well, displaced in proportion to their age, moves, unless the scans show that its
places were occupied all along: the visible part of an inclined trunk creeps while the drone flies by.
"""

# Postponed annotations are left out: native functions need the types themselves.

from typing import Any

import warp as wp

from aero_planner.device.params import Params
from aero_planner.device.records import CloudSweeps, Problem
from aero_planner.kernels.sweep_change import RecentRows, SweepChange
from aero_planner.stages.moving_obstacles.segments import (
    BIN_ANGLE,
    BINS,
    TRACKS,
    Segments,
    origin_of_scan,
    range_of_bin,
)

wp.set_module_options({"enable_backward": False})

STARTS = wp.constant(3)
"""Newest sweeps of which obstacles are followed back."""
LENGTH = wp.constant(6)
"""Sweeps through which an obstacle is followed back."""
_SPEED_MIN = wp.constant(0.4)
"""Speed below which obstacles are treated as static [m/s]."""
_SPEED_MAX = wp.constant(8.0)
"""Largest speed that is looked for [m/s]."""
_GATE = wp.constant(0.25)
"""Distance from where a segment is expected, at most [m]."""
_SAME_RADIUS = wp.constant(0.2)
"""Difference between the radii of a segment in two sweeps, at most [m]."""
_HALF_SWEEP = wp.constant(0.05)
"""Half of the time that a sweep takes [s]."""
_LEAST_MATCHES = wp.constant(3)
"""Older sweeps that show the segment, at least."""
_RESIDUAL = wp.constant(0.07)
"""Root mean square distance from uniform motion, at most [m]."""
_LEAST_DEVIATION = wp.constant(0.025)
"""Standard deviation of the position of a circle, at least [m]."""
_SIGNIFICANCE = wp.constant(8.0)
"""Ratio of the speed to its standard deviation, at least: occluded edges make static obstacles creep."""
_GHOST_SPEED = wp.constant(0.8)
"""Part of the speed limit above which an obstacle leaves ghost points."""

GROWTH = wp.constant(0.1)
"""Rate at which the radius of a predicted obstacle grows, since it changes its velocity [m/s]."""
_AGE_MAX = wp.constant(wp.float64(0.5))
"""Age of the newest sweep up to which its tracks are used [s]; negative while a recorded sweep is not complete."""


@wp.struct
class FoundTracks:
    """Segments that move, by the sweep in which they were last seen; X is `TRACKS`."""

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
    of the `STARTS` newest sweeps are followed, since an obstacle may be occluded for a while.
    Launched over [B, STARTS, TRACKS].
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
    if n < float(_LEAST_MATCHES + 1) or speed < _SPEED_MIN or speed > _SPEED_MAX:
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


@wp.struct
class Tracks:
    """Vertical cylinders with a constant horizontal velocity; X is `TRACKS`."""

    track_time: wp.array(dtype=wp.float64)  # [B], when they are where they are [s]; NaN: none are known
    track_count: wp.array(dtype=int)  # [B]
    track_position: wp.array2d(dtype=wp.vec2)  # [B, X], axis, world frame [m]
    track_velocity: wp.array2d(dtype=wp.vec2)  # [B, X], world frame [m/s]
    track_radius: wp.array2d(dtype=float)  # [B, X], [m]


@wp.kernel
def merge_tracks(
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # in
    found: FoundTracks,
    # out
    tracks: Tracks,
):
    """List what was found in the newest sweep, then what was last found in older ones. Launched over [B]."""
    b = wp.tid()
    row = change[0].recent[0]
    if row < 0:
        return
    count = int(0)
    for begin in range(STARTS):
        known = count
        for i in range(TRACKS):
            if found.radius[b, begin, i] >= 0.0:
                position = found.position[b, begin, i]
                is_new = count < TRACKS
                for k in range(known):
                    reach = tracks.track_radius[b, k] + _GATE
                    if wp.length(tracks.track_position[b, k] - position) < reach:
                        is_new = False
                if is_new:
                    tracks.track_position[b, count] = position
                    tracks.track_velocity[b, count] = found.velocity[b, begin, i]
                    tracks.track_radius[b, count] = found.radius[b, begin, i]
                    count += 1
    tracks.track_count[b] = count
    tracks.track_time[b] = cloud.time[b, row]


@wp.struct
class DynamicObstacles:
    """Dynamic obstacles at the start of a plan."""

    dynamic_count: wp.array(dtype=int)  # [B]
    dynamic_position: wp.array2d(dtype=wp.vec2)  # [B, X], axis, world frame [m]
    dynamic_velocity: wp.array2d(dtype=wp.vec2)  # [B, X], world frame [m/s]
    dynamic_radius: wp.array2d(dtype=float)  # [B, X], [m]


@wp.kernel
def place_obstacles(
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    # in
    tracks: Tracks,
    # out
    obstacles: DynamicObstacles,
):
    """List the tracks where they will be when the plan takes effect. Launched over [B]."""
    b = wp.tid()
    obstacles.dynamic_count[b] = 0
    age = problem.time[b] - tracks.track_time[b]
    # False without a stamp.
    if params[b].predict != 0 and wp.abs(age) < _AGE_MAX:
        elapsed = float(age) + params[b].delay
        for i in range(tracks.track_count[b]):
            velocity = tracks.track_velocity[b, i]
            obstacles.dynamic_position[b, i] = tracks.track_position[b, i] + elapsed * velocity
            obstacles.dynamic_velocity[b, i] = velocity
            obstacles.dynamic_radius[b, i] = tracks.track_radius[b, i] + elapsed * GROWTH
        obstacles.dynamic_count[b] = tracks.track_count[b]


@wp.func
def clear_of_obstacles(d: float, x: wp.vec3, time: float, b: int, views: Any, c: Any) -> float:
    """Return the smaller of d and the distance from x to the nearest dynamic obstacle, a time after the start [m]."""
    for i in range(views.moving_obstacles.dynamic_count[b]):
        position = views.moving_obstacles.dynamic_position[b, i]
        offset = wp.vec2(x[0], x[1]) - position - time * views.moving_obstacles.dynamic_velocity[b, i]
        gap = wp.length(offset) - views.moving_obstacles.dynamic_radius[b, i] - time * GROWTH
        d = wp.min(d, wp.max(gap, 0.0))
    return d


@wp.func
def is_ghost(b: int, x: wp.vec3, time: wp.float64, views: Any, c: Any) -> int:
    """Return 1 if a track was where a point was measured, at the time of its sweep, and has left the place since.

    The points that a fast obstacle leaves are a wall to a slow drone. Those of a slow one keep a fast drone away from
    where it may turn back to, and stay. The latest points stay, too: the track has hardly left where they are. See
    `Hooks.ghost`.
    """
    view = views.moving_obstacles
    result = int(0)
    if c.predict != 0:
        since = float(view.track_time[b] - time)
        for i in range(view.track_count[b]):
            velocity = view.track_velocity[b, i]
            speed = wp.length(velocity)
            reach = view.track_radius[b, i] + _GATE
            # False without a stamp.
            if speed > _GHOST_SPEED * c.speed_limit and speed * since > 2.0 * reach:
                axis = view.track_position[b, i] - (since + _HALF_SWEEP) * velocity
                if wp.length(wp.vec2(x[0], x[1]) - axis) < reach + _HALF_SWEEP * speed:
                    result = 1
    return result
