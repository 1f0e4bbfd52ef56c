"""Horizontal scans of the newest sweeps, and the circles of what they show; `tracks` follows those that move.

Each sweep becomes a scan: the nearest range of the points near the drone's height, by azimuth around the place where
the sweep was measured. Neighbouring bins of similar range form a segment, and a circle is laid through each segment
that nothing hides.

All sweeps are cut at the height at which the newest one arrived, so that the section of an inclined trunk stands still
while the drone climbs.
"""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.device.params import Params
from aero_planner.device.records import CloudSweeps, Problem
from aero_planner.device.rotations import near_atan2
from aero_planner.kernels.sweep_change import RECENT, RecentRows, SweepChange

wp.set_module_options({"enable_backward": False})

BINS = wp.constant(720)
"""Bins of a scan around the horizon."""
BIN_ANGLE = wp.constant(2.0 * 3.14159265 / 720.0)
"""Width of a bin [rad]."""
TRACKS = wp.constant(32)
"""Largest number of segments of a sweep, and of dynamic obstacles."""
_RANGE = wp.constant(20.0)
"""Range beyond which obstacles are treated as static [m]."""
_WIDTH = wp.constant(1.6)
"""Width beyond which obstacles are treated as static [m]."""
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
_NEAREST = wp.constant(0x7F000000)
"""Entry of a scan for the range 0; it falls with the range, and is 0 for an empty bin."""

BLOCK = wp.constant(30)
"""Bins of a block, in which circles are counted."""


@wp.struct
class Circles:
    """Circle of the segment that begins at each bin of each recent sweep."""

    center: wp.array3d(dtype=wp.vec2)  # [B, RECENT, BINS], world frame [m]
    radius: wp.array3d(dtype=float)  # [B, RECENT, BINS], [m]; 0 for none
    count: wp.array3d(dtype=int)  # [B, RECENT, BINS / BLOCK], number of circles of each block of bins


@wp.struct
class Segments:
    """Circles of the segments of each recent sweep; X is `TRACKS`."""

    count: wp.array2d(dtype=int)  # [B, RECENT]
    center: wp.array3d(dtype=wp.vec2)  # [B, RECENT, X], world frame [m]
    radius: wp.array3d(dtype=float)  # [B, RECENT, X], [m]


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
    threads: int,
    change: wp.array(dtype=SweepChange),
    # problem
    problem: Problem,
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # out
    scan: wp.array3d(dtype=int),  # 0 before
):
    """Find the nearest range of each bin of the recent sweeps. Launched over [B, RECENT, threads per sweep]."""
    b, recent, thread = wp.tid()
    rows = change[0].recent
    row = rows[recent]
    if row < 0 or params[b].predict == 0:
        return
    first = cloud.start[row]
    level = cloud.origin[b, rows[0]][2]
    ground = problem.ground_height[b]
    origin = origin_of_scan(b, recent, rows, cloud)
    for i in range(thread, cloud.count[b, row], threads):
        point = cloud.points[b, first + i]
        # False for a point that is not finite.
        height = point[2] - level
        if height >= -_BELOW and height <= _ABOVE and point[2] >= ground + _ABOVE_GROUND:
            offset = point - origin
            r = wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
            if r > params[b].range_min and r <= _RANGE:
                k = int((near_atan2(offset[1], offset[0]) / (2.0 * wp.PI) + 0.5) * float(BINS)) % BINS
                # The bits of positive floats have the order of the floats.
                wp.atomic_max(scan, b, recent, k, _NEAREST - wp.cast(r, wp.int32))


@wp.func
def range_of_bin(scan: wp.array3d(dtype=int), b: int, recent: int, k: int) -> float:
    """Return the range of a bin, whose number may be beyond the last one; 0 for an empty bin."""
    entry = scan[b, recent, (k + BINS) % BINS]
    return wp.where(entry == 0, 0.0, wp.cast(_NEAREST - entry, float))


@wp.func
def circle_of_segment(
    b: int, recent: int, first: int, last: int, origin: wp.vec3, scan: wp.array3d(dtype=int)
) -> wp.vec3:
    """Return centre and radius of the circle of a segment [m], world frame; radius 0 for one too small or too large."""
    none = wp.vec3(0.0, 0.0, 0.0)
    bins = last - first + 1
    sine = wp.sin(0.5 * (float(bins) - 0.5) * BIN_ANGLE)
    if bins < _LEAST_BINS or sine > _LARGEST_SINE:
        return none
    total = float(0.0)
    found = float(0.0)
    for k in range(first + bins // 3, last - bins // 3 + 1):
        r = range_of_bin(scan, b, recent, k)
        if r > 0.0:
            total += r
            found += 1.0
    if found == 0.0:
        return none
    front = total / found
    radius = front * sine / (1.0 - sine)
    if 2.0 * radius > _WIDTH:
        return none
    angle = 0.5 * float(first + last + 1) * BIN_ANGLE - wp.PI
    return wp.vec3(origin[0] + (front + radius) * wp.cos(angle), origin[1] + (front + radius) * wp.sin(angle), radius)


@wp.kernel
def find_segments(
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # configuration
    params: wp.array(dtype=Params),
    # in
    scan: wp.array3d(dtype=int),
    # out
    circles: Circles,  # the counts are 0 before
):
    """Find the circle of the segment that begins at each bin, unless something occludes either end.

    Launched over [B, RECENT, BINS]; a thread walks along its segment.
    """
    b, recent, first = wp.tid()
    circles.radius[b, recent, first] = 0.0
    rows = change[0].recent
    if rows[recent] < 0 or params[b].predict == 0:
        return
    last_range = range_of_bin(scan, b, recent, first)
    if last_range == 0.0:
        return
    before = float(0.0)
    for gap in range(_GAP):
        if before == 0.0:
            before = range_of_bin(scan, b, recent, first - 1 - gap)
    if before > 0.0 and before <= last_range + _JUMP:
        return  # it continues the segment before, or that one hides its end
    last = first
    k = first + 1
    while k - last <= _GAP and last - first < BINS // 3:
        r = range_of_bin(scan, b, recent, k)
        if r > 0.0:
            if wp.abs(r - last_range) > _JUMP:
                if r < last_range:
                    return  # occluded
                break
            last = k
            last_range = r
        k += 1
    if last - first < BINS // 3:
        circle = circle_of_segment(b, recent, first, last, origin_of_scan(b, recent, rows, cloud), scan)
        circles.center[b, recent, first] = wp.vec2(circle[0], circle[1])
        circles.radius[b, recent, first] = circle[2]
        if circle[2] > 0.0:
            wp.atomic_add(circles.count, b, recent, first // BLOCK, 1)


@wp.kernel
def list_segments(
    # in
    circles: Circles,
    # out
    segments: Segments,
):
    """List the circles of each sweep in the order of their first bins. Launched over [B, RECENT, BINS].

    The slot of a circle is the number of those before it: in whole blocks, and in its own.
    """
    b, recent, first = wp.tid()
    radius = circles.radius[b, recent, first]
    if radius == 0.0 and first > 0:
        return
    slot = int(0)
    total = int(0)
    block = first // BLOCK
    for k in range(BINS // BLOCK):
        count = circles.count[b, recent, k]
        total += count
        if k < block:
            slot += count
    for k in range(block * BLOCK, first):
        if circles.radius[b, recent, k] > 0.0:
            slot += 1
    if radius > 0.0 and slot < TRACKS:
        segments.center[b, recent, slot] = circles.center[b, recent, first]
        segments.radius[b, recent, slot] = radius
    if first == 0:
        segments.count[b, recent] = wp.min(total, TRACKS)
