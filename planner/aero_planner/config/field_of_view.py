"""The field of view of a mounted sensor, for `partition.view_min` and `partition.view_max`."""

from __future__ import annotations

import math

_TOLERANCE = math.cos(math.radians(3.0))
"""Cosine of the largest tilt of a sensor that counts as upright or upside down: the size of a fine cell."""


def mounted_view(view: tuple[float, float], *, roll: float, pitch: float) -> tuple[float, float]:
    """Return the lowest and the highest elevation that a mounted sensor sees [deg], body frame.

    The view of a tilted sensor has no edge at one elevation. The result is then (-90, 90), which continues no surface.

    Args:
        view: lowest and highest elevation [deg], sensor frame.
        roll, pitch: rotation of the sensor in the body frame [deg].
    """
    upright = math.cos(math.radians(roll)) * math.cos(math.radians(pitch))
    if upright >= _TOLERANCE:
        return view
    if upright <= -_TOLERANCE:
        return -view[1], -view[0]
    return -90.0, 90.0
