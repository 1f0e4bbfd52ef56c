"""Conversion between thrust in newtons and the autopilot's normalised thrust, based on the hover thrust."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class ThrustModel:
    """PX4's motor model: the total thrust at the normalised thrust s in [0, 1] is F(s) = F_1 ((1 - c) s + c s^2).

    F_1, the thrust at full signal, need not be known: hovering gives F(h) = m g at the hover thrust h.
    """

    mass: float = 1.0
    """m [kg]."""
    gravity: float = 9.81
    """g [m/s^2]."""
    hover_thrust: float = 0.5
    """h, the normalised thrust at which the vehicle hovers, in (0, 1]; PX4's MPC_THR_HOVER."""
    curve: float = 0.0
    """c in [0, 1]. 0 if the autopilot linearises the thrust itself (THR_MDL_FAC fits the motors). Only with
    THR_MDL_FAC = 0 is it the motors' own curve, up to 1 for a thrust proportional to the square of the signal."""

    def force(self, signal: float) -> float:
        """Return the total thrust [N] at a normalised thrust."""
        return self.mass * self.gravity * _shape(signal, self.curve) / _shape(self.hover_thrust, self.curve)

    def signal(self, force: float) -> float:
        """Return the normalised thrust in [0, 1] whose total thrust is nearest to `force` [N]."""
        ratio = force / (self.mass * self.gravity) * _shape(self.hover_thrust, self.curve)
        return min(1.0, _solve(ratio, self.curve))


def calibrate_hover_thrust(
    signals: ArrayLike, accelerations: ArrayLike, *, gravity: float = 9.81, curve: float = 0.0
) -> float:
    """Return the hover thrust h that fits a log best, by least squares in the specific force.

    Args:
        signals: Normalised thrusts sent, shape [n].
        accelerations: Specific force along the body's z axis at the same times, as an accelerometer measures it
            (9.81 in hover) [m/s^2], shape [n].
        gravity: g [m/s^2].
        curve: c in [0, 1], see `ThrustModel`.

    Raises:
        ValueError: The log has other shapes, is empty, is not finite, or contains no thrust.
    """
    s, a = np.asarray(signals, dtype=np.float64), np.asarray(accelerations, dtype=np.float64)
    if s.ndim != 1 or s.shape != a.shape or len(s) == 0 or not (np.isfinite(s).all() and np.isfinite(a).all()):
        raise ValueError(
            f"the log has signals of shape {s.shape} and accelerations of shape {a.shape}; "
            "give one finite number of each per sample."
        )
    shape = (1.0 - curve) * s + curve * s * s
    if not shape @ a > 0.0:
        raise ValueError("the log contains no thrust; give a log of hovering with signals in (0, 1].")
    gain = (shape @ a) / (shape @ shape)  # a = gain ((1 - c) s + c s^2)
    return _solve(float(gravity / gain), curve)


def _shape(signal: float, curve: float) -> float:
    return (1.0 - curve) * signal + curve * signal * signal


def _solve(value: float, curve: float) -> float:
    """Return the s >= 0 with (1 - c) s + c s^2 = value; 0 for negative values."""
    if value <= 0.0:
        return 0.0
    # The positive root in a form without cancellation, which is also valid for c = 0.
    linear = 1.0 - curve
    return 2.0 * value / (linear + math.sqrt(linear * linear + 4.0 * curve * value))
