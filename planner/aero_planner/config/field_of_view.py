"""The field of view of a mounted sensor, for the parameters `unseen_space.view_*`."""

from __future__ import annotations

import math
from typing import NamedTuple

FULL_WIDTH = 360.0
"""Width of a view all around [deg]."""
_TOLERANCE = math.cos(math.radians(3.0))
"""Cosine of the largest tilt of a sensor that counts as upright or upside down: the size of a fine cell."""


class View(NamedTuple):
    """A field of view between two elevations, and as wide around a middle azimuth."""

    lowest: float
    """[deg]"""
    highest: float
    width: float = FULL_WIDTH
    middle: float = 0.0
    """Positive to the left [deg]."""


def mounted_view(view: View, *, roll: float, pitch: float, yaw: float = 0.0) -> View:
    """Return what a mounted sensor sees, body frame.

    The view all around of a tilted sensor has no edge at one elevation. The result is then -90 to 90 deg, which
    continues no surface. A narrow view is moved by its pitch; one that is rolled otherwise than upside down shrinks to
    the cone that fits into it.

    Args:
        view: the field of view, sensor frame.
        roll, pitch, yaw: rotation from sensor to body, R = R_z(yaw) R_y(pitch) R_x(roll) [deg].
    """
    level = math.cos(math.radians(roll))
    if view.width >= FULL_WIDTH:
        upright = level * math.cos(math.radians(pitch))
        if upright >= _TOLERANCE:
            return view
        if upright <= -_TOLERANCE:
            return view._replace(lowest=-view.highest, highest=-view.lowest)
        return View(-90.0, 90.0)
    if level <= -_TOLERANCE:
        view = View(-view.highest, -view.lowest, view.width, -view.middle)
    elif level < _TOLERANCE:
        cone = min(0.5 * view.width, view.highest, -view.lowest)
        view = View(-cone, cone, 2.0 * cone, view.middle * level)
    drop = pitch * math.cos(math.radians(view.middle))
    lowest, highest = (min(max(elevation - drop, -90.0), 90.0) for elevation in (view.lowest, view.highest))
    return View(lowest, highest, view.width, math.remainder(view.middle + yaw, FULL_WIDTH))
