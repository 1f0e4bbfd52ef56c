"""Jumps of an autopilot's estimate that come without a reset counter."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import integrate_rates

__all__ = ["EstimatorState", "is_estimator_reset"]

Array = NDArray[np.float64]

_OFFSET, _ACCELERATION = 0.5, 30.0  # [m], [m/s^2]
_TURN, _ANGULAR_ACCELERATION = 0.15, 200.0  # [rad], [rad/s^2]


class EstimatorState(NamedTuple):
    """A state by the autopilot's own clock, in any frames as long as they stay the same."""

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
    """Return whether no flight leads from one state to the other.

    That is: time goes back; or the position lies more than 0.5 m off where the mean of both velocities leads, or the
    attitude more than 0.15 rad off where the mean of both rates does, beyond what speeding up by 30 m/s^2 (200 rad/s^2)
    and slowing down again can do in the time between, a dt^2 / 4.
    """
    dt = after.time - before.time
    if dt <= 0.0:
        return True
    change = 0.25 * dt * dt
    led = before.position + 0.5 * dt * (before.velocity + after.velocity)
    turned = integrate_rates(before.attitude, 0.5 * (before.rates + after.rates), dt)
    offset = float(np.linalg.norm(after.position - led))
    turn = 2.0 * math.acos(min(abs(float(turned @ after.attitude)), 1.0))
    return offset > _OFFSET + _ACCELERATION * change or turn > _TURN + _ANGULAR_ACCELERATION * change
