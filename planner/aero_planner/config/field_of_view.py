"""The fields of view of the sensors on a drone, and their text, the parameter `unseen_space.view`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

VIEWS = 2
"""Largest number of views that a planner knows."""
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


_NUMBER = r"[+-]?\d+(\.\d+)?"
_VIEW = rf" *{_NUMBER}( +{_NUMBER}){{1,3}} *"
VIEW_PATTERN = rf"{_VIEW}(;{_VIEW}){{0,{VIEWS - 1}}}"
"""What the text of one view or of several matches as a whole."""
VIEW_FORM = "lowest and highest elevation [and width [and middle in azimuth]], once or twice, separated by a semicolon"


def parse_views(text: str) -> tuple[View, ...]:
    """Return the views in a text that matches `VIEW_PATTERN`, such as "-29 29 87 0; -29 29 87 180" [deg].

    Raises:
        ValueError: a view is empty or exceeds the sphere; quotes it.
    """
    parts = text.split(";")
    views = tuple(View(*map(float, part.split())) for part in parts)
    for view, part in zip(views, parts, strict=True):
        if not (-90.0 <= view.lowest < view.highest <= 90.0 and 0.0 < view.width <= FULL_WIDTH):
            raise ValueError(
                f"{part.strip()!r}; elevations must ascend from -90 to 90 deg, and a width is at most 360 deg"
            )
    return views


def format_views(views: Iterable[View]) -> str:
    """Return the text of some views, to 0.001 deg, without what is the default."""
    rounded = (View(*(round(number, 3) for number in view)) for view in views)
    return "; ".join(
        " ".join(f"{number:.7g}" for number in (view if view.middle else view[: 2 if view.width >= FULL_WIDTH else 3]))
        for view in rounded
    )


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
        cone = max(min(0.5 * view.width, view.highest, -view.lowest), 1.0)
        view = View(-cone, cone, 2.0 * cone, view.middle * level)
    drop = pitch * math.cos(math.radians(view.middle))
    lowest, highest = max(view.lowest - drop, -90.0), min(view.highest - drop, 90.0)
    return View(min(lowest, 89.0), max(highest, -89.0), view.width, math.remainder(view.middle + yaw, FULL_WIDTH))
