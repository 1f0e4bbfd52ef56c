"""Moving obstacles as vertical cylinders with a constant horizontal velocity, and the clearance from them."""

# Postponed annotations are left out: Warp structs need the types themselves.

import warp as wp

from aero_planner.kernels.params import Params
from aero_planner.kernels.records import CloudSweeps

wp.set_module_options({"enable_backward": False})

MOVERS = wp.constant(32)
"""Largest number of moving obstacles of a drone."""
_AGE_MAX = wp.constant(wp.float64(0.5))
"""Age of the newest sweep up to which its tracks are used [s]; negative while a recorded sweep is not complete."""


@wp.struct
class Movers:
    """Moving obstacles at the start of a plan."""

    count: wp.array(dtype=int)  # [B]
    position: wp.array2d(dtype=wp.vec2)  # [B, X], axis, world frame [m]
    velocity: wp.array2d(dtype=wp.vec2)  # [B, X], world frame [m/s]
    radius: wp.array2d(dtype=float)  # [B, X], [m]


@wp.kernel
def place_movers(
    # problem
    time: wp.array(dtype=wp.float64),
    # configuration
    params: wp.array(dtype=Params),
    # in
    newest: wp.array(dtype=int),
    cloud: CloudSweeps,
    # out
    movers: Movers,
):
    """List the tracks of the newest sweep where they will be when the plan takes effect. Launched over [B]."""
    b = wp.tid()
    movers.count[b] = 0
    row = newest[0]
    if row < 0 or params[b].predict == 0:
        return
    age = time[b] - cloud.time[b, row]
    # False without a stamp.
    if wp.abs(age) < _AGE_MAX:
        elapsed = float(age) + params[b].delay
        count = cloud.track_count[b, row]
        for i in range(count):
            movers.position[b, i] = cloud.track_position[b, row, i] + elapsed * cloud.track_velocity[b, row, i]
            movers.velocity[b, i] = cloud.track_velocity[b, row, i]
            movers.radius[b, i] = cloud.track_radius[b, row, i] + elapsed * params[b].predict_growth
        movers.count[b] = count


@wp.func
def clear_of_movers(d: float, x: wp.vec3, time: float, b: int, movers: Movers, params: Params) -> float:
    """Return the smaller of d and the distance from x to the nearest moving obstacle, a time after the start [m].

    The radius grows with the time, since obstacles change their velocity.
    """
    for i in range(movers.count[b]):
        offset = wp.vec2(x[0], x[1]) - movers.position[b, i] - time * movers.velocity[b, i]
        gap = wp.length(offset) - movers.radius[b, i] - time * params.predict_growth
        d = wp.min(d, wp.max(gap, 0.0))
    return d
