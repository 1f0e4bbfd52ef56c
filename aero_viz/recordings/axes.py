"""Frames whose names say that their axes are not forward, left, up, as those of a body are here."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_of_matrix


class Axes(NamedTuple):
    """The axes of a frame."""

    name: str
    """What they are, for the user."""
    rotation: NDArray[np.float64]
    """Quaternion [4] w, x, y, z from the frame to one of the same origin whose axes are forward, left, up."""


_OPTICAL = Axes(
    "right, down, forward (REP 103)",
    quaternion_of_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])),
)
_DOWNWARD = Axes("forward, right, down", np.array([0.0, 1.0, 0.0, 0.0]))
_NAMES = {
    r"(^|[_/-])optical([_-]?(frame|link))?(_\d+)?$": _OPTICAL,
    r"(^|[_/-])(frd|fsd)([_-]?(frame|link))?$": _DOWNWARD,
}
"""Ends of names of frames, which ROS's drivers of cameras and PX4's bridges agree on."""


def other_axes(frame: str) -> Axes | None:
    """Return the axes that the name of a frame tells, None if they are forward, left, up."""
    return next((axes for name, axes in _NAMES.items() if re.search(name, frame, re.IGNORECASE)), None)
