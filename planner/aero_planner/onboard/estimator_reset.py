"""Detection of resets of an autopilot's estimator that are not reported by a reset counter."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import integrate_rates

Array = NDArray[np.float64]

_MAX_OFFSET, _MAX_ACCELERATION = 0.5, 30.0  # [m], [m/s^2]
_MAX_ANGLE, _MAX_ANGULAR_ACCELERATION = 0.15, 200.0  # [rad], [rad/s^2]


class EstimatorState(NamedTuple):
    """The autopilot's estimate at one time by its own clock, in any frame as long as it stays the same."""

    time: float
    """[s]"""
    position: Array
    """[m], shape [3]."""
    velocity: Array
    """[m/s], shape [3]."""
    attitude: Array
    """Unit quaternion, shape [4]."""
    rates: Array
    """Body rates [rad/s], shape [3]."""


def is_estimator_reset(before: EstimatorState, after: EstimatorState) -> bool:
    """Return True if no flight leads from one state to the other.

    That is the case if time goes back, if the position is more than 0.5 m from where the mean of both velocities leads,
    or if the attitude is more than 0.15 rad from where the mean of both body rates leads. To both limits a dt^2 / 4 is
    added, the most that accelerating at a = 30 m/s^2 (200 rad/s^2) and slowing down again can do in the time dt.
    """
    dt = after.time - before.time
    if dt <= 0.0:
        return True
    growth = 0.25 * dt * dt
    expected_position = before.position + 0.5 * dt * (before.velocity + after.velocity)
    expected_attitude = integrate_rates(before.attitude, 0.5 * (before.rates + after.rates), dt)
    offset = float(np.linalg.norm(after.position - expected_position))
    angle = 2.0 * math.acos(min(abs(float(expected_attitude @ after.attitude)), 1.0))
    return offset > _MAX_OFFSET + _MAX_ACCELERATION * growth or angle > _MAX_ANGLE + _MAX_ANGULAR_ACCELERATION * growth
