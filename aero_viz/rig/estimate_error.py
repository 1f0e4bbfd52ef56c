"""The error of the position and velocity that the rig's autopilot reports, and the uncertainty that it states."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_POSITION_STD, _VELOCITY_STD = 0.2, 0.05  # [m], [m/s]; reported while the position is known
# A lost position, after a flight of PX4 1.17 whose GNSS was switched off: in 13 s, its error grows to 6 m, and its
# reported variance from 0.04 to 31 m^2.
_DRIFT = np.array([0.05, 0.05, 0.0])  # acceleration of the error [m/s^2]
_POSITION_STD_GROWTH, _VELOCITY_STD_GROWTH = 0.032, 0.065  # both [m/s^2], the first with the square of the time


class EstimateError(NamedTuple):
    """Errors and reported standard deviations."""

    position: NDArray[np.float64]
    """[m], shape [3]."""
    velocity: NDArray[np.float64]
    """[m/s], shape [3]."""
    position_std: float
    """[m]"""
    velocity_std: float
    """[m/s]"""


def estimate_error(lost: float, *, height_offset: float) -> EstimateError:
    """Return the error of the estimate.

    Args:
        lost: time for which the position has been lost [s]; 0 while it is known.
        height_offset: constant error of the height [m].
    """
    return EstimateError(
        np.array([0.0, 0.0, height_offset]) + 0.5 * lost * lost * _DRIFT,
        lost * _DRIFT,
        _POSITION_STD + _POSITION_STD_GROWTH * lost * lost,
        _VELOCITY_STD + _VELOCITY_STD_GROWTH * lost,
    )


def covariance(std: float) -> list[float]:
    """Return the upper triangle of a 6 x 6 covariance of which, as in PX4, only the diagonal is known."""
    values = [math.nan] * 21
    values[0] = values[6] = values[11] = std * std
    return values
