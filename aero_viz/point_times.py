"""Names and units of the time of a point, in messages and in files of clouds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

_NAMES = ("t", "time", "timestamp", "offsettime", "timeoffset", "timeoffsetns", "timestampoffset", "pointtime")
_NAMES += ("pointtimeoffset", "relativetime", "relativetimestamp", "timens", "timestampns", "deltatime", "ts", "stamp")
_NAMES += ("gpstime",)
"""Names without underscores, spaces and CloudCompare's "scalar" and in lower case; the preferred one first."""
_FORMATS = ("i4", "u4", "f4", "f8", "i8", "u8")
UNITS = (1.0, 1e-9, 1e-6, 1e-3)
"""Units that drivers write [s], the preferred one first; only floats are in seconds."""
_MIN_SWEEP, _MAX_SWEEP = 1e-3, 2.0
"""Limits of a sweep's duration [s]."""
_WHOLE, _ROUNDING = 0.8, 1e-6
"""Least share of a sweep from its first to its last point, and largest excess beyond its limits."""
_SECOND = (0.7, 1.5)
"""Times between sweeps that last a second [s]."""
_USUAL_SWEEP = 0.1
"""Duration of a sweep where sweeps are left out between those that were kept [s]."""


def time_field(formats: Mapping[str, str]) -> str | None:
    """Return the name of the field that holds the time of a point, None if there is none.

    Args:
        formats: NumPy format of each field, such as "f4" or "<u4", by its name.
    """
    plain = {
        name.lower().replace("_", "").replace(" ", "").removeprefix("scalar"): name
        for name, code in formats.items()
        if code.lstrip("<>=") in _FORMATS
    }
    return next((plain[name] for name in _NAMES if name in plain), None)


def time_unit(values: NDArray[np.generic], period: float | None = None) -> float | None:
    """Return the unit of the times of a sweep's points [s], or None if the values make no sense as times.

    Drivers write seconds, milliseconds, microseconds or nanoseconds, and the message does not say which. A sweep lasts
    between 1 ms and 2 s: that settles the unit, unless only a small part of the sweep hit something. Of the sweeps of
    one topic, the largest ones therefore settle it for all. Times from 0 to 1 are seconds only if sweeps follow one
    another that slowly; else they are shares of a sweep.

    Args:
        values: times of the points of one sweep.
        period: time from one sweep to the next [s]; None where it is not known.
    """
    units = UNITS if values.dtype.kind == "f" else UNITS[1:]
    times = values.astype(np.float64)
    times = times[np.isfinite(times)]
    if not len(times):
        return None
    span = float(times.max() - times.min())
    is_share = values.dtype.kind == "f" and times.min() >= -_ROUNDING and _WHOLE <= times.max() <= 1.0 + _ROUNDING
    if period is not None and is_share and span >= _WHOLE and not _SECOND[0] <= period <= _SECOND[1]:
        return min(period, _USUAL_SWEEP) if period > _SECOND[1] else period
    return next((unit for unit in units if _MIN_SWEEP <= span * unit <= _MAX_SWEEP), None)


def point_times(values: NDArray[np.generic], stamp: int, unit: float | None = None) -> NDArray[np.float32] | None:
    """Return times after the stamp [ns] in seconds, or None if the values make no sense as times.

    They are counted from the stamp, from 1970 or from the sensor's start. A few points without a time get that of the
    points next to them.

    Args:
        values: the times as they are recorded [P].
        stamp: the stamp of the sweep [ns].
        unit: unit of the times [s]; None finds it from these values.
    """
    unit = unit or time_unit(values)
    times = values.astype(np.float64)
    known = np.isfinite(times)
    if unit is None or 2 * np.count_nonzero(known) <= len(times):
        return None
    if not known.all():
        times = np.interp(np.arange(len(times)), np.flatnonzero(known), times[known])
    first, last = float(times.min()), float(times.max())
    if (last - first) * unit > _MAX_SWEEP:
        return None
    if abs(first * unit) <= _MAX_SWEEP:
        return (times * unit).astype(np.float32)
    offset = first * unit - stamp * 1e-9
    # If the times are those of another clock than the stamp's, the stamp is the first point's.
    offset = offset if abs(offset) <= _MAX_SWEEP else 0.0
    return ((times - first) * unit + offset).astype(np.float32)
