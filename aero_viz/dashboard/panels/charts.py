"""The last seconds as curves."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import viser
import viser.uplot

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session import Frame

__all__ = ["ChartPanel"]

_ROWS = 150
"""The page gets the whole curve each time, so it must stay short."""
_AXIS: Any = {
    "stroke": palette.css(palette.MUTED),
    "grid": {"stroke": palette.css(palette.GRID_SECTION), "width": 1},
    "size": 42,
}


class ChartPanel(Panel):
    """Speed and clearance, and the time of a plan, over the source's time."""

    def create(self, gui: viser.GuiApi) -> None:
        self._epoch = -1
        self._rows: deque[tuple[float, float, float, float]] = deque(maxlen=_ROWS)
        self._motion = _chart(gui, ("speed [m/s]", palette.TRAIL), ("clearance [m]", palette.CHOSEN))
        self._plan = _chart(gui, ("plan [ms]", palette.GUIDE))

    def update(self, frame: Frame) -> list[Change]:
        if frame.epoch != self._epoch:
            self._epoch = frame.epoch
            self._rows.clear()
        if self._rows and frame.time <= self._rows[-1][0]:
            return []
        state = frame.observation.true_state or frame.observation.state
        speed = float(np.linalg.norm(np.asarray(state.velocity)))
        clearance = float(frame.plan.clearance[int(frame.plan.best)].min())
        self._rows.append((frame.time, speed, clearance, frame.timings_ms.get("plan", 0.0)))
        time, speeds, clearances, plan = np.array(self._rows).T
        return [(self._motion, "data", (time, speeds, clearances)), (self._plan, "data", (time, plan))]


def _chart(gui: viser.GuiApi, *curves: tuple[str, palette.Rgb]) -> viser.GuiUplotHandle:
    nothing = np.zeros(1)
    series = [viser.uplot.Series(label="t [s]")]
    series += [viser.uplot.Series(label=label, stroke=palette.css(color), width=1.5) for label, color in curves]
    return gui.add_uplot(
        (nothing,) * len(series),
        tuple(series),
        scales={"x": viser.uplot.Scale(time=False)},
        axes=(_AXIS, _AXIS),
        height=130,
    )
