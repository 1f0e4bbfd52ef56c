"""The end of a flight on an obstacle: where it hit, what, and how it met the surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.explain.hidden_points import surface_normal
from aero_viz.scenes import World
from aero_viz.session.frame import Frame

Array = NDArray[np.float64]

_HEAD_ON, _GRAZING, _MEETING_MIN = 30.0, 65.0, 0.3
"""Angles between velocity and normal [deg], and the speed from which they are told [m/s]."""


def meeting_sentence(normal: Array | None, velocity: Array) -> list[str]:
    """Say how the drone met a surface, with its velocity against it [m/s]; nothing where the surface is not known."""
    speed = float(np.linalg.norm(velocity))
    if normal is None or speed < _MEETING_MIN:
        return []
    angle = float(np.degrees(np.arccos(np.clip(abs(normal @ velocity) / speed, 0.0, 1.0))))
    how = "head-on" if angle < _HEAD_ON else "at a grazing angle" if angle > _GRAZING else "at a slant"
    return [f"It met the surface {how} at {speed:.1f} m/s, {angle:.0f} deg from its normal."]


def contact(frame: Frame, world: World | None, position: Array) -> tuple[Array, str, Array | None]:
    """Return the place that was hit [m], shape [3], the name of the obstacle, and its normal there if it is known."""
    if world is None:
        points = np.concatenate([np.asarray(frame.observation.points), position[None]])
        place = points[np.linalg.norm(points[:-1] - position, axis=1).argmin() if len(points) > 1 else 0]
        return place, "an obstacle", surface_normal(points[:-1], place)
    distance, name = world.nearest(position)
    steps = 1e-3 * np.eye(3)
    slope = (world.distance(position + steps) - world.distance(position - steps)) / 2e-3
    length = float(np.linalg.norm(slope))
    normal = slope / max(length, 1e-9)
    return position - distance * normal, name, normal if length > 0.5 else None
