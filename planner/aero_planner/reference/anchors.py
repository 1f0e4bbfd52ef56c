"""Anchors: M_h x M_v endpoints around the direction of the goal, moved to safe directions."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.dynamics import State, rotation
from aero_planner.reference.parameters import Parameters
from aero_planner.reference.partition import COARSE_COLUMNS, COARSE_ROWS, cell_of, safe_cell

wp.set_module_options({"enable_backward": False})


@wp.func
def lookahead(p0: wp.vec3, p_goal: wp.vec3, c: Parameters) -> float:
    """Return min(l, |p_goal - p0|)."""
    return wp.min(c.l, wp.length(p_goal - p0))


@wp.func
def anchor_direction(h: int, v: int, M_h: int, M_v: int, x0: State, p_goal: wp.vec3, c: Parameters) -> wp.vec3:
    """Return (cos b cos a, cos b sin a, sin b) with a = a_goal + (h - (M_h - 1) / 2) 18 deg, and b likewise.

    The azimuth and the elevation of the goal are those in the world; at the goal, straight ahead takes its place.
    """
    way = p_goal - x0.p
    if wp.length(way) < 1.0e-3:
        way = rotation(x0.q) * wp.vec3(1.0, 0.0, 0.0)
    spacing = wp.radians(c.spacing)
    a = wp.atan2(way[1], way[0]) + (float(h) - 0.5 * float(M_h - 1)) * spacing
    b = wp.atan2(way[2], wp.sqrt(way[0] * way[0] + way[1] * way[1])) + (float(v) - 0.5 * float(M_v - 1)) * spacing
    return wp.vec3(wp.cos(b) * wp.cos(a), wp.cos(b) * wp.sin(a), wp.sin(b))


@wp.kernel
def place_anchors(
    x0: State, goal: State, M_h: int, c: Parameters, directions: wp.array(dtype=wp.vec3),
    initial_endpoints: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Write the initial endpoints p0 + l d, and d in the body frame. Launched over [M]."""
    m = wp.tid()
    d = anchor_direction(m % M_h, m // M_h, M_h, directions.shape[0] // M_h, x0, goal.p, c)
    directions[m] = wp.transpose(rotation(x0.q)) * d
    initial_endpoints[m] = x0.p + lookahead(x0.p, goal.p, c) * d


@wp.kernel
def refine_anchors(
    x0: State, goal: State, c: Parameters, directions: wp.array(dtype=wp.vec3), fine_range: wp.array2d(dtype=float),
    anchors: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Write the refined endpoints p0 + l d, d being the safe direction of the coarse cell. Launched over [M]."""
    m = wp.tid()
    row, column = cell_of(directions[m], COARSE_ROWS, COARSE_COLUMNS)
    _r, d = safe_cell(row, column, directions[m], fine_range)
    anchors[m] = x0.p + lookahead(x0.p, goal.p, c) * (rotation(x0.q) * d)
