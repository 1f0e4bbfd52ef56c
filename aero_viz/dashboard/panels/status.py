"""What the planner does, in figures and colours, and what the colours of the scene mean."""

from __future__ import annotations

import time

import numpy as np
import viser

from aero_planner import PlanStatus
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer, cost_scale
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame

__all__ = ["StatusPanel"]

_STATUS = {
    PlanStatus.OK: ("OK", palette.GOOD),
    PlanStatus.NO_SAFE_CANDIDATE: ("no safe candidate: braking", palette.BAD),
    PlanStatus.STALE_CLOUD: ("no cloud", palette.WARNING),
}
_OUTCOMES = {"arrived": palette.GOOD, "collision": palette.BAD, "end": palette.MUTED}
_KEYS = {
    "rollouts": (("chosen rollout", palette.CHOSEN),),
    "guides": (("guides", palette.GUIDE),),
    "anchors": (("initial endpoints", palette.ENDPOINT), ("refined anchors", palette.ANCHOR)),
    "coarse_cells": (("coarse cells", palette.GRID_SECTION),),
    "drone": (("drone", palette.DRONE),),
    "trail": (("flown trail", palette.TRAIL),),
    "recorded_path": (("recorded path", palette.RECORDED),),
    "goal": (("goal", palette.GOAL),),
    "obstacles": (("obstacles", palette.OBSTACLE),),
    "ground": (("ground grid", palette.GRID_SECTION),),
}
"""What is drawn in one colour."""
_SLOW = 1.1
"""From which on a flight that lags behind is said to."""
_SETTLED = 1.0
"""How long `Frame.rate` remembers [s]: before, it tells of a pause or of another speed, too."""


class StatusPanel(Panel):
    """Status, figures, stage times, costs of the instances, legend."""

    def create(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("")
        self._pace: tuple[bool, float] | None = None
        self._paced_since = 0.0

    def wait(self) -> list[Change]:
        return [(self._html, "content", markup.block(markup.text(self.session.waiting)))]

    def update(self, frame: Frame) -> list[Change]:
        return [(self._html, "content", markup.block(*self._parts(frame)))]

    def _parts(self, frame: Frame) -> list[str]:
        return [self._state(frame), _figures(frame), _stages(frame), self._costs(frame), *self._legend(frame)]

    def _state(self, frame: Frame) -> str:
        words = [markup.pill(*_STATUS[PlanStatus(int(frame.plan.status))])]  # type: ignore[arg-type]
        if frame.outcome is not None:
            words.append(markup.pill(frame.outcome.replace("_", " "), _OUTCOMES.get(frame.outcome, palette.WARNING)))
        elif not self.session.playing:
            words.append(markup.pill("paused", palette.MUTED))
        if lag := self._lag(frame):
            words.append(markup.muted(lag))
        told = (*frame.source.scenery.notices, *([frame.explanation] if frame.explanation else []))
        notices = "".join(
            f'<div style="color:{palette.css(palette.WARNING)};margin-top:3px">{markup.text(notice)}</div>'
            for notice in told
        )
        name = f"<b>{markup.text(frame.source.name)}</b> {markup.muted(f'{frame.time:.2f} s')}"
        return f'<div style="margin-bottom:5px">{name}</div>{"".join(words)}{notices}'

    def _lag(self, frame: Frame) -> str:
        """Return what it costs that ticks come late: a recording and a drone lose some, a flight takes its time."""
        if frame.dropped_ticks:
            return f"{frame.dropped_ticks} ticks lost"
        pace = playing, speed = self.session.playing, self.session.speed
        if pace != self._pace:
            self._pace, self._paced_since = pace, time.monotonic()
        flown = frame.source.closed_loop and not self.session.read_only
        if not (flown and playing and frame.rate) or time.monotonic() - self._paced_since < _SETTLED:
            return ""
        slower = speed / (frame.rate * frame.source.period)
        if slower < _SLOW:
            return ""
        return f"{slower:.1f} times slower than {'real time' if speed == 1.0 else 'asked for'}"

    def _costs(self, frame: Frame) -> str:
        plan, best = frame.plan, int(frame.plan.best)
        by = self._rollouts.color_by
        place = cost_scale(plan, by=by)
        paint = palette.colorize(place, 0.0, 1.0, palette.COST)
        columns = [
            (
                1.0 - 0.9 * place[i],
                f"{i} {kind}: S2 {plan.stage2_cost[i]:.4g} = goal {plan.goal_cost[i]:.4g} + collision "
                f"{plan.collision_cost[i]:.4g} + options",
                palette.CHOSEN if i == best else tuple(int(c) for c in paint[i]),
                i == best,
            )
            for i, kind in enumerate(plan.kinds)
        ]
        head = markup.heading(f"cost, {by}", f"best is {best} of {len(plan.kinds)} ({plan.kinds[best]})")
        return head + markup.bars(columns)  # type: ignore[arg-type]

    def _legend(self, frame: Frame) -> list[str]:
        shown = {name: layer for name, layer in self.page.layers.items() if layer.visible and layer.available}
        parts = []
        if "rollouts" in shown:
            cost = frame.plan.stage2_cost
            by = "rank" if self._rollouts.color_by == "rank" else "logarithm"
            label = f"rollouts: {by} of the Stage II cost"
            parts.append(markup.scale(label, f"worst: {cost.max():.4g}", f"best: {cost.min():.4g}", palette.COST))
        if "samples" in shown:
            parts.append(markup.scale("samples: rank of the Stage I cost", "worst", "best", palette.VIRIDIS[51:]))
        cloud = shown.get("cloud")
        if isinstance(cloud, CloudLayer) and cloud.scale is not None:
            parts.append(markup.scale(*cloud.scale))
        reach = f"{frame.config.partition.range_max:g} m"
        if "fine_cells" in shown:
            parts.append(markup.scale("occupied cells: range", "0 m", reach, palette.NEAR_TO_FAR))
        if "coarse_cells" in shown:
            parts.append(markup.scale("safe directions: free range", "0 m", reach, palette.VIRIDIS))
        return [*parts, markup.key(entry for name, entries in _KEYS.items() if name in shown for entry in entries)]

    @property
    def _rollouts(self) -> RolloutLayer:
        layer = self.page.layers["rollouts"]
        assert isinstance(layer, RolloutLayer)
        return layer


def _figures(frame: Frame) -> str:
    state = frame.observation.actual_state
    position = np.asarray(state.position)
    away = np.linalg.norm(np.asarray(frame.observation.goal.position) - position)
    clearance, reach = float(frame.plan.clearance[int(frame.plan.best)].min()), frame.config.costs.distance_max
    far = clearance >= reach - 1e-4
    return markup.metrics(
        [
            ("speed", f"{np.linalg.norm(np.asarray(state.velocity)):.1f}", "m/s"),
            ("height", f"{position[2]:.1f}", "m"),
            ("to the goal", f"{away:.1f}", "m"),
            ("clearance", f"{'≥' if far else ''}{reach if far else clearance:.2f}", "m"),
            ("points kept", f"{len(frame.plan.filtered_points)}", f"/{len(frame.observation.points) // 1000}k"),
            ("ticks", f"{frame.rate:.0f}", "Hz"),
        ]
    )


def _stages(frame: Frame) -> str:
    stages = {name: ms for name, ms in frame.plan.stage_ms.items() if name != "total"}
    colors = palette.VIRIDIS[np.linspace(70, 245, max(len(stages), 2)).astype(int)]
    parts = [
        (name, ms, tuple(int(c) for c in color)) for (name, ms), color in zip(stages.items(), colors, strict=False)
    ]
    total = frame.plan.stage_ms.get("total", sum(stages.values()))
    head = markup.heading("plan", f"{total:.1f} ms = {1e3 / max(total, 1e-3):.0f} Hz")
    return head + markup.stacked(parts, "ms")  # type: ignore[arg-type]
