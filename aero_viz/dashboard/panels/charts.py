"""Charts of the flight."""

from __future__ import annotations

import bisect
from typing import Any, NamedTuple

import numpy as np
import viser
import viser.uplot

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

__all__ = ["ChartPanel"]

_ROWS = 150
"""Longest curve. It must stay short, since every update sends the whole curve."""
_AXIS: Any = {
    "stroke": palette.css(palette.MUTED),
    "grid": {"stroke": palette.css(palette.GRID_SECTION), "width": 1},
    "size": 42,
}


class _Row(NamedTuple):
    """Values of one tick."""

    time: float
    speed: float
    clearance: float
    reach: float
    """Largest clearance that the planner measures [m]."""
    plan_ms: float


class ChartPanel(Panel):
    """Speed, clearance and plan time over source time, with a vertical line at the current tick."""

    def create(self, gui: viser.GuiApi) -> None:
        self._rows: list[_Row] = []
        self._frame: Frame | None = None
        self._reach = self.session.config.costs.distance_max
        self.motion = _chart(gui, _motion_series(self._reach))
        self.plan_time = _chart(gui, (_curve("plan [ms]", palette.GUIDE), _MARK))

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._rows, self._frame = [], None
        return []

    def update(self, frame: Frame) -> list[Change]:
        previous, self._frame = self._frame, frame
        if frame is previous:
            return []
        changes: list[Change] = [(self.motion, "visible", True), (self.plan_time, "visible", True)]
        row = _row(frame)
        if row.reach != self._reach:
            self._reach = row.reach
            changes.append((self.motion, "series", (_TIME, *_motion_series(self._reach))))
        # After a step back the later rows stay visible. They belong to another flight once this one advances again.
        advanced = previous is not None and frame.epoch == previous.epoch and frame.time > previous.time
        self._rows = [r for r in self._rows if r.time < row.time or (r.time > row.time and not advanced)]
        if len(self._rows) >= _ROWS:
            time = np.array([r.time for r in self._rows])
            del self._rows[1 + int(np.argmin(time[2:] - time[:-2]))]  # where rows are closest
        bisect.insort(self._rows, row)
        # With a single row the time axis would have no length, and the page would keep the previous axis.
        rows = self._rows if len(self._rows) > 1 else [row, row._replace(time=row.time + frame.source.period)]
        current = rows.index(row)
        # The vertical line is a spike: three rows at the same time, of which the middle one is 1.
        time, speed, clearance, reach, plan = np.array([*rows[:current], row, row, *rows[current:]]).T
        mark = (np.arange(len(time)) == current + 1).astype(np.float64)
        changes.append((self.motion, "data", (time, speed, clearance, reach, mark)))
        return [*changes, (self.plan_time, "data", (time, plan, mark))]


def _row(frame: Frame) -> _Row:
    return _Row(
        time=frame.time,
        speed=float(np.linalg.norm(np.asarray(frame.observation.actual_state.velocity))),
        clearance=float(frame.plan.clearance[int(frame.plan.best)].min()),
        reach=frame.config.costs.distance_max,
        plan_ms=frame.timings_ms.get("plan", 0.0),
    )


def _curve(label: str, color: palette.Rgb, **options: Any) -> viser.uplot.Series:
    return viser.uplot.Series(label=label, stroke=palette.css(color), width=1.5, **options)


_TIME = viser.uplot.Series(label="t [s]")
_MARK = viser.uplot.Series(
    label="now", scale="mark", stroke=palette.css(palette.DRONE), width=1.0, points={"show": False}
)


def _motion_series(reach: float) -> tuple[viser.uplot.Series, ...]:
    return (
        _curve("speed [m/s]", palette.TRAIL),
        _curve("clearance [m]", palette.CHOSEN),
        _curve(f"≥ {reach:.2f} m", palette.MUTED, dash=(4, 4), points={"show": False}),
        _MARK,
    )


def _chart(gui: viser.GuiApi, series: tuple[viser.uplot.Series, ...]) -> viser.GuiUplotHandle:
    return gui.add_uplot(
        (np.zeros(2),) * (1 + len(series)),
        (_TIME, *series),
        scales={"x": viser.uplot.Scale(time=False), "mark": viser.uplot.Scale(range=(0.02, 1.0))},
        axes=(_AXIS, _AXIS),
        height=130,
        visible=False,
    )
