"""Points near the drone that no surface explains are removed from the sweep that arrives.

Rain, dust and insects return points anywhere within about a metre. A surface, or a wire, returns its points sweep after
sweep at the same places, and most were measured from farther away before. Points are therefore counted in a grid of
small voxels around the drone: those near the drone in the newest sweeps, before anything was removed, and all that a
remembered sweep has measured from afar. A near point is stray if it has few of the former and none of the latter around
it. Points farther away are kept.
"""

# Postponed annotations are left out: kernels need the types themselves.

import warp as wp

from aero_planner.device.records import CloudSweeps
from aero_planner.kernels.sweep_change import SweepChange

wp.set_module_options({"enable_backward": False})

SWEEPS = wp.constant(20)
"""Newest sweeps that support the points of the newest one."""
LISTED = wp.constant(8192)
"""Most near points of a sweep. One with more is full of surfaces; it is kept whole and supports nothing."""
SIDE = wp.constant(64)
"""Voxels along an edge of the grid."""
_VOXEL = wp.constant(0.04)
"""Edge of a voxel [m]: a few times the noise of ranges and poses."""
_NEAR = wp.constant(1.25)
"""Distance from the middle of the drone's way during the sweep within which points need support [m]."""
_FAR = wp.constant(2.0)
"""Distance within which points are listed, and from which they are no rain, seen from the end of their sweep [m]."""
_SUPPORT = wp.constant(26)
"""Least number of points in 3 x 3 x 3 voxels. Around a drone that hovers, 500 points of rain a sweep leave 9 there in
two seconds, and a wire of 8 mm radius, a metre away, 59."""
_SUPPORT_NOW = wp.constant(8)
"""Least number of points there of the newest sweep alone, for a surface that moves. Rain leaves 0.5."""


@wp.struct
class NearPoints:
    """Points near the drone of the newest sweeps, in a ring of SWEEPS lists, and their grid."""

    near_slot: wp.array(dtype=int)  # [B], list of the newest sweep
    near_time: wp.array(dtype=wp.float64)  # [B], when this sweep arrived [s]
    near_count: wp.array2d(dtype=int)  # [B, SWEEPS], near points of each sweep
    near_points: wp.array3d(dtype=wp.vec3)  # [B, SWEEPS, LISTED], world frame [m]
    near_grid: wp.array3d(dtype=int)  # [B, 2, SIDE^3], support by each voxel: of all sweeps, of the newest one


@wp.func
def middle_of_sweep(b: int, change: SweepChange, cloud: CloudSweeps) -> wp.vec3:
    """Return the middle of the drone's way during the sweep that arrives [m]."""
    origin = cloud.origin[b, change.arrived]
    before = change.recent[1]
    if before >= 0:
        origin = 0.5 * (origin + cloud.origin[b, before])
    return origin


@wp.func
def voxel_of(point: wp.vec3, middle: wp.vec3) -> wp.vec3i:
    """Return the voxel of a point; beyond the grid, its indices are outside [0, SIDE)."""
    offset = (point - middle) * (1.0 / _VOXEL)
    half = float(SIDE) * 0.5
    return wp.vec3i(int(wp.floor(offset[0] + half)), int(wp.floor(offset[1] + half)), int(wp.floor(offset[2] + half)))


@wp.func
def cell_of(x: int, y: int, z: int) -> int:
    """Return the index of a voxel, -1 beyond the grid."""
    inside = x >= 0 and x < SIDE and y >= 0 and y < SIDE and z >= 0 and z < SIDE
    return wp.where(inside, (x * SIDE + y) * SIDE + z, -1)


@wp.func
def add_support(near: NearPoints, b: int, plane: int, point: wp.vec3, middle: wp.vec3, support: int):
    """Add support to the voxel of a point, if that is in the grid."""
    voxel = voxel_of(point, middle)
    cell = cell_of(voxel[0], voxel[1], voxel[2])
    if cell >= 0:
        wp.atomic_add(near.near_grid, b, plane, cell, support)


@wp.func
def is_within(distance: float, point: wp.vec3, middle: wp.vec3) -> bool:
    """Return whether a point is nearer than a distance [m]; False for one that is not finite."""
    offset = point - middle
    return wp.dot(offset, offset) < distance * distance


@wp.kernel
def begin_list(
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # out
    near: NearPoints,
):
    """Begin the list of the sweep that arrives in place of the oldest one. Launched over [B].

    One that is no newer than the last one begins the memory again, and the lists.
    """
    b = wp.tid()
    row = change[0].arrived
    if row < 0:
        return
    if not cloud.time[b, row] > near.near_time[b]:
        for i in range(SWEEPS):
            near.near_count[b, i] = 0
    slot = (near.near_slot[b] + 1) % SWEEPS
    near.near_slot[b] = slot
    near.near_count[b, slot] = 0
    near.near_time[b] = cloud.time[b, row]


@wp.kernel
def list_near(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # out
    near: NearPoints,
):
    """List the points of the sweep that arrives within `_FAR`. Launched over [B, threads per sweep]."""
    b, thread = wp.tid()
    row = change[0].arrived
    if row < 0:
        return
    slot = near.near_slot[b]
    middle = middle_of_sweep(b, change[0], cloud)
    for i in range(thread, cloud.count[b, row], threads):
        point = cloud.points[b, cloud.start[row] + i]
        if is_within(_FAR, point, middle):
            place = wp.atomic_add(near.near_count, b, slot, 1)
            if place < LISTED:
                near.near_points[b, slot, place] = point


@wp.kernel
def count_voxels(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # out
    near: NearPoints,
):
    """Count the listed points of all sweeps by voxel. Launched over [B, SWEEPS, threads per sweep]."""
    b, slot, thread = wp.tid()
    if change[0].arrived < 0:
        return
    count = near.near_count[b, slot]
    if count > LISTED:
        return
    middle = middle_of_sweep(b, change[0], cloud)
    for i in range(thread, count, threads):
        point = near.near_points[b, slot, i]
        add_support(near, b, 0, point, middle, 1)
        if slot == near.near_slot[b]:
            add_support(near, b, 1, point, middle, 1)


@wp.kernel
def count_far(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # problem
    cloud: CloudSweeps,
    # out
    near: NearPoints,
):
    """Add enough support for each point that was measured from afar. Launched over [B, sweeps, threads per sweep]."""
    b, sweep, thread = wp.tid()
    row = change[0].arrived
    if row < 0 or cloud.is_ordered[sweep] == 0:
        return  # the latter has not arrived yet, or is being thinned
    middle = middle_of_sweep(b, change[0], cloud)
    apart = middle - cloud.origin[b, sweep]
    if wp.length(apart) < _FAR - _NEAR:
        return  # no point is near now and was far then
    for i in range(thread, cloud.count[b, sweep], threads):
        point = cloud.points[b, cloud.start[sweep] + i]
        if is_within(_NEAR, point, middle) and wp.length(point - cloud.origin[b, sweep]) > _FAR:
            add_support(near, b, 0, point, middle, _SUPPORT)


@wp.kernel
def remove_stray(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # in
    near: NearPoints,
    # in and out
    cloud: CloudSweeps,
):
    """Remove the near points of the sweep that arrives without support. Launched over [B, threads per sweep]."""
    b, thread = wp.tid()
    row = change[0].arrived
    if row < 0 or near.near_count[b, near.near_slot[b]] > LISTED:
        return
    middle = middle_of_sweep(b, change[0], cloud)
    for i in range(thread, cloud.count[b, row], threads):
        index = cloud.start[row] + i
        point = cloud.points[b, index]
        if is_within(_NEAR, point, middle):
            voxel = voxel_of(point, middle)
            found = int(0)
            found_now = int(0)
            for k in range(27):
                cell = cell_of(voxel[0] + k // 9 - 1, voxel[1] + (k // 3) % 3 - 1, voxel[2] + k % 3 - 1)
                if cell >= 0:
                    found += near.near_grid[b, 0, cell]
                    found_now += near.near_grid[b, 1, cell]
            if found < _SUPPORT and found_now < _SUPPORT_NOW:
                cloud.points[b, index] = wp.vec3(wp.NAN)
