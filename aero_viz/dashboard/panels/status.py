"""What the planner does, in figures and colours, and what the colours of the scene mean."""

from __future__ import annotations

import numpy as np
import viser

from aero_planner import PlanStatus
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer, cost_scale
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session import Frame

__all__ = ["StatusPanel"]

_STATUS = {
    PlanStatus.OK: ("OK", palette.GOOD),
    PlanStatus.NO_SAFE_CANDIDATE: ("no safe candidate: braking", palette.BAD),
    PlanStatus.STALE_CLOUD: ("no cloud", palette.WARNING),
}
_OUTCOMES = {"arrived": palette.GOOD, "collision": palette.BAD, "end": palette.MUTED}
_KEYS = {
    "rollouts": ("chosen rollout", palette.CHOSEN),
    "guides": ("guides", palette.GUIDE),
    "anchors": ("refined anchors", palette.ANCHOR),
    "trail": ("flown trail", palette.TRAIL),
    "goal": ("goal", palette.GOAL),
    "recorded_path": ("recorded path", palette.RECORDED),
}


class StatusPanel(Panel):
    """Status, figures, stage times, costs of the instances, legend."""

    def create(self, gui: viser.GuiApi) -> None:
        self._html = gui.add_html("")

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
        if frame.dropped_ticks:
            words.append(markup.muted(f"{frame.dropped_ticks} ticks lost"))
        told = (*frame.source.scenery.notices, *([frame.explanation] if frame.explanation else []))
        notices = "".join(
            f'<div style="color:{palette.css(palette.WARNING)};margin-top:3px">{markup.text(notice)}</div>'
            for notice in told
        )
        name = f"<b>{markup.text(frame.source.name)}</b> {markup.muted(f'{frame.time:.2f} s')}"
        return f'<div style="margin-bottom:5px">{name}</div>{"".join(words)}{notices}'

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
        layers = self.page.layers
        parts = []
        if layers["rollouts"].visible:
            cost = frame.plan.stage2_cost
            parts.append(
                markup.scale("rollouts: Stage II cost", f"{cost.max():.4g}", f"{cost.min():.4g} (best)", palette.COST)
            )
        cloud = layers["cloud"]
        if isinstance(cloud, CloudLayer) and cloud.visible and cloud.scale is not None:
            label, low, high, table = cloud.scale
            parts.append(markup.scale(label, low, high, table))
        parts.append(
            markup.key(value for name, value in _KEYS.items() if layers[name].visible and layers[name].available)
        )
        return parts

    @property
    def _rollouts(self) -> RolloutLayer:
        layer = self.page.layers["rollouts"]
        assert isinstance(layer, RolloutLayer)
        return layer


def _figures(frame: Frame) -> str:
    state = frame.observation.true_state or frame.observation.state
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
