"""The lanes of the curves: signals that share an axis, and the points of them that a page draws."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.history import Past
from aero_viz.dashboard.signals import FIRST_SHOWN, Axis, Signal, signal

Array = NDArray[np.float64]
_AXIS_WIDTH = 52
"""Width of the numbers on the left of a lane [pixels]."""


@dataclass(frozen=True)
class Lane:
    """Signals that share an axis."""

    axis: Axis
    signals: tuple[Signal, ...]


def available(past: Past) -> list[Signal]:
    """Return the signals of which something is known."""
    names = [name for name in past.columns if name != "time"]
    is_known = lambda name: np.isfinite(past.column(name)).any() or np.isfinite(past.column(name, of_ghost=True)).any()  # noqa: E731
    return [signal(name) for name in names if is_known(name)]


def chosen(signals: Sequence[Signal], names: Sequence[str] | None) -> list[Lane]:
    """Return the lanes of the signals with these names, in the order of their axes; None are those shown at first."""
    costs = [one.name for one in signals if one.name.endswith("_cost")]
    wanted = (*FIRST_SHOWN, *costs) if names is None else names
    ranked = sorted((one for one in signals if one.name in wanted), key=lambda one: _rank(one, signals))
    axes = dict.fromkeys(one.axis for one in ranked)
    return [Lane(axis, tuple(one for one in ranked if one.axis == axis)) for axis in axes]


def _rank(one: Signal, signals: Sequence[Signal]) -> tuple[int, int]:
    first = [signal(name).axis for name in FIRST_SHOWN]
    at = signals.index(one)
    return (first.index(one.axis) if one.axis in first else len(first) + at, at)


def height(lane: Lane) -> int:
    """Return the height of a lane [pixels]: room for the curves, and for the names next to them."""
    return max(72, 20 + 14 * len(lane.signals))


def points(lane: Lane, past: Past, span: tuple[float, float] | None, buckets: int, *, gap: float) -> tuple[Array, ...]:
    """Return the times to draw [s], and the values of each signal there: of the flight, and of a ghost after them.

    Where there are more ticks than `buckets`, each bucket keeps the ticks at which a signal is smallest or largest, so
    that no dip is lost. Between ticks of the one flight, values of the other are interpolated. NaN is outside of a
    flight, and where it has no ticks for longer than `gap`.

    Args:
        lane: signals of the lane.
        past: the flight and its ghost.
        span: times that are looked at [s], which get as many buckets as everything else together; None is all of them.
        buckets: number of buckets.
        gap: longest time to draw a line across [s].
    """
    flights: list[tuple[Array, Array, Array]] = []
    for of_ghost in (False, True)[: 1 + (len(past.ghost) > 0)]:
        times = past.column("time", of_ghost=of_ghost)
        values = np.stack([past.column(one.name, of_ghost=of_ghost) for one in lane.signals], axis=1)
        flights.append((times, values, times[kept_rows(times, values, span, buckets)]))
    jumps = [times[:-1][np.diff(times) > gap] + 0.5 * gap for times, _, _ in flights]
    shown = np.unique(np.concatenate([*(kept for _, _, kept in flights), *jumps]))
    return shown, *(_resampled(shown, times, column, gap) for times, values, _ in flights for column in values.T)


def _resampled(shown: Array, times: Array, values: Array, gap: float) -> Array:
    """Return the values at other times, NaN where nothing is known."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(shown), np.nan)
    times, values = times[known], values[known]
    before = np.clip(np.searchsorted(times, shown, side="right") - 1, 0, len(times) - 1)
    after = np.minimum(before + 1, len(times) - 1)
    is_jump = (times[after] - times[before] > gap) & (shown > times[before])
    found = np.interp(shown, times, values, left=np.nan, right=np.nan)
    return np.where(is_jump, np.nan, found)


def kept_rows(times: Array, values: Array, span: tuple[float, float] | None, buckets: int) -> NDArray[np.intp]:
    """Return the numbers of the rows that `points` keeps.

    Args:
        times: increasing [s], shape [n].
        values: shape [n, s].
        span: times that are looked at [s]; None is all of them.
        buckets: number of buckets.
    """
    if len(times) <= 2 * buckets:
        return np.arange(len(times))
    bucket = _bucket(times, (times[0], times[-1]), buckets)
    if span is not None:
        is_inside = (times >= span[0]) & (times <= span[1])
        bucket = np.where(is_inside, buckets + _bucket(times, span, buckets), bucket)
        bucket = np.where(times > span[1], bucket + 2 * buckets, bucket)
    firsts = np.flatnonzero(np.diff(bucket, prepend=-1.0))
    sizes = np.diff(firsts, append=len(times))
    kept = [firsts, np.array([len(times) - 1])]
    for column in values.T:
        for extreme in (np.fmin, np.fmax):
            rows = np.flatnonzero(column == np.repeat(extreme.reduceat(column, firsts), sizes))
            _, first = np.unique(bucket[rows], return_index=True)
            kept.append(rows[first])
    return np.unique(np.concatenate(kept))


def _bucket(times: Array, span: tuple[float, float], buckets: int) -> Array:
    place = (times - span[0]) / max(span[1] - span[0], 1e-9)
    return np.floor(np.clip(place, 0.0, 1.0) * (buckets - 1))


def options(lane: Lane, data: Sequence[Array], ghost_name: str | None) -> dict[str, Any]:
    """Return the options of uPlot for a lane.

    Args:
        lane: signals of the lane.
        data: its points.
        ghost_name: name of the ghost; None without a ghost.
    """
    colors = [palette.CURVES[i % len(palette.CURVES)] for i in range(len(lane.signals))]
    series: list[Any] = [{"label": lane.axis.title}]
    for one, color in zip(lane.signals, colors, strict=True):
        series.append({"label": one.label, "stroke": palette.css(color), "width": 1.5, "points": {"show": False}})
    if ghost_name is not None:
        for one, color in zip(lane.signals, colors, strict=True):
            line = {"stroke": palette.css(color, 0.6), "width": 1.2, "dash": (5, 4), "points": {"show": False}}
            series.append({"label": f"{one.label} ({ghost_name})", **line})
    return {
        "series": tuple(series),
        "scales": {"x": {"time": False, "range": (None, None)}, "y": _y_scale(lane.axis, data[1:])},
    }


CURSOR: Any = {"sync": {"key": "aero-curves"}, "drag": {"x": True, "y": False, "setScale": False}, "y": False}


def axes(lane: Lane) -> tuple[Any, ...]:
    """Return the axes of uPlot for a lane. The page writes the times below the last lane."""
    grid = {"width": 1, "stroke": palette.css(palette.MUTED, 0.16)}
    return (
        {"size": 0, "ticks": {"show": False}, "font": "1px sans-serif", "grid": grid},
        {
            "size": _AXIS_WIDTH, "space": 22, "gap": 4, "ticks": {"show": False}, "font": "10px system-ui",
            "grid": grid | {"show": not lane.axis.is_log},  # whose lines are too many
        },
    )  # fmt: skip


def _y_scale(axis: Axis, values: Sequence[Array]) -> dict[str, Any]:
    if axis.is_log:
        return {"distr": 4, "asinh": 1}
    if axis.top is not None:
        return {"range": (0.0, axis.top)}
    if axis.has_outliers:
        return {"range": (0.0, _round_top(values))}
    return (
        {"range": {"min": {"pad": 0.0, "soft": 0.0, "mode": 1}, "max": {"pad": 0.1, "soft": 0.0, "mode": 1}}}
        if (axis.from_zero)
        else {}
    )


def _round_top(values: Sequence[Array]) -> float:
    """Return a round number above nearly all values, which therefore seldom changes."""
    known = np.concatenate(values)
    known = np.sort(known[np.isfinite(known)])
    usual = 1.25 * known[int(0.95 * (len(known) - 1))] if len(known) else 1.0
    usual = max(min(usual, known[-1]) if len(known) else 1.0, 1e-3)
    power = 10.0 ** np.floor(np.log10(usual))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= usual - 1e-12))


def table(past: Past, names: Iterable[str]) -> str:
    """Return signals as CSV: a row for each tick of the flight, and then of a ghost. Unknown values are empty cells."""
    columns = ["time", *(name for name in names if name in past.columns)]
    flights = [("", False)] if not len(past.ghost) else [("now", False), (past.ghost_name, True)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns if len(flights) == 1 else ["flight", *columns])
    for name, of_ghost in flights:
        values = np.stack([past.column(column, of_ghost=of_ghost) for column in columns], axis=1)
        first = [name] if name else []
        writer.writerows([[*first, *("" if np.isnan(value) else f"{value:.9g}" for value in row)] for row in values])
    return text.getvalue()
