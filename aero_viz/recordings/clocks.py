"""Comparison of the stamps of sweeps with the times at which they were recorded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_STEP_BACK = 0.5
"""Sweeps of several sensors overtake one another by less than this [s]."""
_STEP_AHEAD = 10.0
"""A delayed sweep arrives less than this after its time [s]."""
_SIMILAR = 3.0
"""Largest ratio of the times between sweeps, by their stamps and by their times of recording."""


class ClockFault(NamedTuple):
    """Fault of the stamps of sweeps."""

    text: str
    """Sentence without a full stop."""
    use_arrivals: bool
    """True if the times of recording can take the place of the stamps."""


def find_clock_fault(stamps: NDArray[np.int64], arrivals: NDArray[np.int64]) -> ClockFault | None:
    """Return what is wrong with the stamps [n] [ns] of sweeps that were recorded at `arrivals` [n] [ns], or None.

    A clock that is set during a recording steps back, or ahead, where the times of recording go on.
    """
    if len(stamps) < 2:
        return None
    order = np.argsort(arrivals, kind="stable")
    stamps, steps = stamps[order], np.diff(arrivals[order]) * 1e-9
    stamped = np.diff(stamps) * 1e-9
    behind, ahead = (np.maximum.accumulate(stamps)[:-1] - stamps[1:]) * 1e-9, stamped - steps
    period, recorded = _typical(stamped), _typical(steps)
    is_usable = recorded > 0.0 and (not period or period / _SIMILAR <= recorded <= period * _SIMILAR)
    if np.ptp(stamps) == 0:
        fault = "the stamps of all sweeps are equal"
    elif behind.max() > _STEP_BACK:
        at = int(np.argmax(behind > _STEP_BACK))
        fault = f"a clock was set, or a replay started again: stamps step back by {behind[at]:.1f} s at sweep {at + 1}"
    elif ahead.max() > _STEP_AHEAD and is_usable:
        at = int(np.argmax(ahead > _STEP_AHEAD))
        fault = f"a clock was set: stamps step ahead by {ahead[at]:.1f} s at sweep {at + 1}"
    else:
        return None
    remedy = "times of recording are used" if is_usable else "the times of recording are no better, so record it again"
    return ClockFault(f"{fault}; {remedy}", is_usable)


def _typical(steps: NDArray[np.float64]) -> float:
    """Return the median of the steps [s] that are longer than a millisecond, zero without any."""
    steps = steps[steps > 1e-3]
    return float(np.median(steps)) if len(steps) else 0.0
