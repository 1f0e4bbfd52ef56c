"""Order of the points of a sweep by their distance from the drone when the sweep arrived.

Spherical shells around that position divide the points. A plan reads only the shells from which a point can be in range
at its own position; the triangle inequality makes that exact, however far the drone has flown. Rays without return are
in no shell.
"""

# Postponed annotations are left out: native functions need the types themselves.

import warp as wp

from aero_planner.device.params import Params
from aero_planner.device.records import CloudSweeps, Problem
from aero_planner.device.warp_ops import claim_slot
from aero_planner.kernels.sweep_change import SweepChange, changed_row
from aero_planner.sweeps import HASH_FACTORS, THINNING

wp.set_module_options({"enable_backward": False})

SHELLS = wp.constant(8)
"""Number of shells; the last one holds all points beyond the others."""
COUNTERS = wp.constant(9)
"""Counters of a sweep: the end of each shell in its list, then the number of points that are not finite."""
SHELL_WIDTH = 1.5
"""Thickness of a shell [m]."""
_THINNING = wp.constant(wp.uint32(THINNING))
_FACTOR_X, _FACTOR_Y, _FACTOR_Z = (wp.constant(wp.uint32(factor)) for factor in HASH_FACTORS)


@wp.func
def shell_of_distance(distance: float, reach: float) -> int:
    """Return the shell at a distance from the centre [m]; `reach` is the radius of the first one."""
    return int(wp.clamp(wp.ceil((distance - reach) * (1.0 / SHELL_WIDTH)), 0.0, float(SHELLS - 1)))


@wp.func
def last_shell(position: wp.vec3, center: wp.vec3, range_max: float, reach: float) -> int:
    """Return the last shell that may hold a point within `range_max` of a position."""
    # The margin is far larger than the rounding of the distances.
    return shell_of_distance(1.0001 * (range_max + wp.length(position - center)) + 1.0e-3, reach)


@wp.func
def shell_of_point(point: wp.vec3, center: wp.vec3, reach: float) -> int:
    """Return the shell of a point, or SHELLS if it is not finite."""
    # The difference is NaN for a component that is not finite.
    if (point[0] - point[0]) + (point[1] - point[1]) + (point[2] - point[2]) == 0.0:
        return shell_of_distance(wp.length(point - center), reach)
    return SHELLS


@wp.kernel
def start_shells(
    change: wp.array(dtype=SweepChange),
    # problem
    problem: Problem,
    # configuration
    params: wp.array(dtype=Params),
    # out
    cloud: CloudSweeps,
):
    """Centre the shells of the sweeps that change on the drones and reset their counters. Launched over [B, 2]."""
    b, k = wp.tid()
    sweep = changed_row(change[0], k)
    if sweep < 0:
        return
    cloud.center[b, sweep] = problem.position[b]
    cloud.reach[b, sweep] = params[b].range_max
    for i in range(COUNTERS):
        cloud.shell_ends[b * cloud.start.shape[0] + sweep, i] = 0


@wp.kernel
def count_shells(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # in and out
    cloud: CloudSweeps,
):
    """Count the points of each shell. Launched over [B, 2, threads per sweep]."""
    b, k, thread = wp.tid()
    sweep = changed_row(change[0], k)
    if sweep < 0:
        return
    first = cloud.start[sweep]
    for i in range(thread, cloud.count[b, sweep], threads):
        shell = shell_of_point(cloud.points[b, first + i], cloud.center[b, sweep], cloud.reach[b, sweep])
        claim_slot(cloud.shell_ends, b * cloud.start.shape[0] + sweep, shell)


@wp.kernel
def begin_shells(
    change: wp.array(dtype=SweepChange),
    # in and out
    cloud: CloudSweeps,
):
    """Turn the counts of the shells into where each begins in the list of its sweep. Launched over [B, 2]."""
    b, k = wp.tid()
    sweep = changed_row(change[0], k)
    if sweep < 0:
        return
    row = b * cloud.start.shape[0] + sweep
    begin = int(0)
    for i in range(SHELLS):
        count = cloud.shell_ends[row, i]
        cloud.shell_ends[row, i] = begin
        begin += count


@wp.kernel
def fill_shells(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # in and out
    cloud: CloudSweeps,
):
    """List the points of each sweep by shell; `shell_ends` become the ends. Launched over [B, 2, threads per sweep]."""
    b, k, thread = wp.tid()
    sweep = changed_row(change[0], k)
    if sweep < 0:
        return
    first = cloud.start[sweep]
    if b + thread == 0:
        cloud.is_ordered[sweep] = 1
    for i in range(thread, cloud.count[b, sweep], threads):
        point = cloud.points[b, first + i]
        shell = shell_of_point(point, cloud.center[b, sweep], cloud.reach[b, sweep])
        if shell < SHELLS:
            slot = claim_slot(cloud.shell_ends, b * cloud.start.shape[0] + sweep, shell)
            index = wp.cast(first + i, wp.float32)
            cloud.ordered_points[b, first + slot] = wp.vec4(point[0], point[1], point[2], index)


@wp.kernel
def thin_sweep(
    threads: int,
    change: wp.array(dtype=SweepChange),
    # in and out
    cloud: CloudSweeps,
):
    """Remove all points of a sweep but one in `THINNING`. Launched over [B, threads]."""
    b, thread = wp.tid()
    sweep = change[0].thinned
    if sweep < 0:
        return
    for i in range(thread, cloud.count[b, sweep], threads):
        index = cloud.start[sweep] + i
        x = cloud.points[b, index]
        digest = wp.cast(x[0], wp.uint32) * _FACTOR_X + wp.cast(x[1], wp.uint32) * _FACTOR_Y
        digest += wp.cast(x[2], wp.uint32) * _FACTOR_Z
        if (digest >> wp.uint32(16)) % _THINNING != wp.uint32(0):
            cloud.points[b, index] = wp.vec3(wp.NAN)
