"""Moving obstacles as vertical cylinders with a constant horizontal velocity, and the clearance from them."""

# Postponed annotations are left out: Warp structs need the types themselves.

import warp as wp

from aero_planner.kernels.params import Params

wp.set_module_options({"enable_backward": False})

MOVERS = wp.constant(32)
"""Largest number of moving obstacles of a drone."""
_AGE_MAX = wp.constant(wp.float64(0.5))
"""Age of the newest sweep up to which its tracks are used [s]."""


@wp.struct
class Tracks:
    """Obstacles that moved in the newest sweeps; X is `MOVERS`."""

    time: wp.array(dtype=wp.float64)  # [B], when the newest sweep arrived [s]
    count: wp.array(dtype=int)  # [B]
    position: wp.array2d(dtype=wp.vec2)  # [B, X], axis at that time, world frame [m]
    velocity: wp.array2d(dtype=wp.vec2)  # [B, X], world frame [m/s]
    radius: wp.array2d(dtype=float)  # [B, X], [m]


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
    tracks: Tracks,
    # out
    movers: Movers,
):
    """List the tracks where they will be when the plan takes effect. Launched over [B]."""
    b = wp.tid()
    count = int(0)
    age = time[b] - tracks.time[b]
    # False without a stamp.
    if params[b].predict != 0 and age > wp.float64(-1.0e-3) and age < _AGE_MAX:
        elapsed = float(age) + params[b].delay
        count = tracks.count[b]
        for i in range(count):
            movers.position[b, i] = tracks.position[b, i] + elapsed * tracks.velocity[b, i]
            movers.velocity[b, i] = tracks.velocity[b, i]
            movers.radius[b, i] = tracks.radius[b, i] + elapsed * params[b].predict_growth
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
