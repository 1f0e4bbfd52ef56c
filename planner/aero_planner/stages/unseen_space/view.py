"""The field of view in kernels: the rows of `params.view` are the views of one or two sensors, see `View`."""

# Postponed annotations are left out: Warp functions need the types themselves.

from typing import Any

import warp as wp

from aero_planner.costs.cost_term import Step
from aero_planner.device.rotations import heading, wrap_angle

wp.set_module_options({"enable_backward": False})

_TURN_TIME = wp.constant(0.4)
"""Time constant with which the drone turns to where it flies [s]."""
TILT_WEIGHT = wp.constant(1000.0)
BEYOND_VIEW = wp.constant(8.0)
"""Angle by which the horizon ahead may leave the view before the tilt costs [deg]."""
_SHORT = wp.constant(0.5)
"""Horizontal length below which a direction of flight has no heading [m], or speed [m/s]."""


@wp.func
def is_within(azimuth: float, i: int, c: Any) -> bool:
    """Return True if an azimuth [rad] is within view i."""
    width = c.view[i, 2]
    off = wp.abs(wrap_angle(azimuth - wp.radians(c.view[i, 3])))
    return width >= 360.0 or (width > 0.0 and off <= 0.5 * wp.radians(width))


@wp.func
def is_narrow(c: Any) -> bool:
    """Return True if the sensors may not see in all azimuths alike."""
    return c.view[0, 2] < 360.0 or c.view[1, 2] > 0.0


@wp.func
def is_beside(azimuth: float, c: Any) -> bool:
    """Return True if nothing is seen at an azimuth [rad]."""
    return not (is_within(azimuth, 0, c) or is_within(azimuth, 1, c))


@wp.func
def edges_of_view(c: Any) -> wp.vec2:
    """Return the lowest and the highest elevation that are seen anywhere [deg]."""
    lowest = c.view[0, 0]
    highest = c.view[0, 1]
    if c.view[1, 2] > 0.0:
        lowest = wp.min(lowest, c.view[1, 0])
        highest = wp.max(highest, c.view[1, 1])
    return wp.vec2(lowest, highest)


@wp.func
def edges_at(azimuth: float, edges: wp.vec2, c: Any) -> wp.vec2:
    """Return the lowest and the highest elevation [deg] that are seen at an azimuth [rad].

    Beside the view they are `edges`, those of the whole view: ground that was seen in passing continues nowhere.
    """
    lowest = float(wp.INF)
    highest = float(-wp.INF)
    for i in range(2):
        if is_within(azimuth, i, c):
            lowest = wp.min(lowest, c.view[i, 0])
            highest = wp.max(highest, c.view[i, 1])
    if lowest > highest:
        return edges
    return wp.vec2(lowest, highest)


@wp.func
def tilt_cost(s: Step, c: Any) -> float:
    """Return a cost of the tilt beyond which the horizon ahead leaves the view: TILT_WEIGHT (cos limit - e_z)^2.

    e_z is the vertical part of the thrust axis. The limit is `BEYOND_VIEW` above the upper edge of the view, since the
    drone remembers what it has just seen.
    """
    limit = wp.radians(edges_of_view(c)[1] + BEYOND_VIEW)
    excess = wp.max(0.0, wp.cos(limit) - 1.0 + 2.0 * (s.q[1] * s.q[1] + s.q[2] * s.q[2]))
    return TILT_WEIGHT * excess * excess


@wp.func
def flight_heading(along: wp.vec3, otherwise: float) -> float:
    """Return the heading of a direction of flight [rad], or another one where that is short or steep."""
    level = wp.sqrt(along[0] * along[0] + along[1] * along[1])
    return wp.where(level > wp.max(_SHORT, wp.abs(along[2])), wp.atan2(along[1], along[0]), otherwise)


@wp.func
def look_ahead(rate: float, q: wp.vec4, along: wp.vec3, otherwise: float, views: Any, c: Any) -> float:
    """Return the yaw rate that turns a narrow view to where the drone flies [rad/s], see `Hooks.turn`."""
    if c.view[0, 2] >= 360.0 or c.view[1, 2] >= 360.0:
        return rate
    return wrap_angle(flight_heading(along, otherwise) - heading(q)) / _TURN_TIME
