"""Identifies the lag between commanded and measured values from a log."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

_LONGEST = 1.0  # [s]
_STEPS = 200


def identify_lag(times: ArrayLike, commands: ArrayLike, values: ArrayLike) -> float:
    """Return the time constant of the first-order lag that fits a log best, by least squares [s].

    The lag follows dy = (c - y) / tau, with a gain and an offset that are fitted as well. Call it once per axis: with
    body rates for `vehicle.rate_lag` and `onboard.response.rate_lag`; with the thrust setpoint and the specific force
    along the body's z axis for the thrust lags.

    Args:
        times: Times of the samples, increasing [s], shape [n].
        commands: Commands in effect from each time on, shape [n].
        values: Measured values at these times, in any unit, shape [n].

    Raises:
        ValueError: The log has other shapes, is not finite or not in order, is too short, or its commands are constant.
    """
    t, c, y = (np.asarray(values, dtype=np.float64) for values in (times, commands, values))
    if t.ndim != 1 or t.shape != c.shape or t.shape != y.shape or not all(np.isfinite(x).all() for x in (t, c, y)):
        raise ValueError(
            f"the log has times, commands and values of shapes {t.shape}, {c.shape} and {y.shape}; give one finite "
            "number of each per sample."
        )
    if len(t) < 10 or not (np.diff(t) > 0.0).all():
        raise ValueError(f"the log has {len(t)} samples; give at least 10, with increasing times.")
    if np.ptp(c) == 0.0:
        raise ValueError("the commands never change; give a log of a flight with turns.")
    lags = np.geomspace(1e-3, _LONGEST, _STEPS)
    errors = [_error(_follow(t, c, lag), y) for lag in lags]
    best = int(np.argmin(errors))
    # Refine between the neighbours.
    fine = np.linspace(lags[max(best - 1, 0)], lags[min(best + 1, _STEPS - 1)], 21)
    return float(fine[int(np.argmin([_error(_follow(t, c, lag), y) for lag in fine]))])


def _follow(times: NDArray[np.float64], commands: NDArray[np.float64], lag: float) -> NDArray[np.float64]:
    """Return the values of a lag that follows the commands, shape [n]."""
    result, value = np.empty_like(commands), float(commands[0])
    result[0] = value
    for k, dt in enumerate(np.diff(times)):
        value = commands[k] + math.exp(-dt / lag) * (value - commands[k])
        result[k + 1] = value
    return result


def _error(predicted: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """Return the sum of squared errors after the best gain and offset."""
    design = np.stack([predicted, np.ones_like(predicted)], axis=1)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    return float(((design @ solution - values) ** 2).sum())
