"""Figures on the current plan, and the legend of the scene."""

from __future__ import annotations

import time

import numpy as np
import viser

from aero_planner import PlannerConfig, PlanStatus
from aero_viz.cost_text import cost_text
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change, legend_entries
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame
from aero_viz.session.source import RecordedPlan

_STATUS = {
    PlanStatus.OK: ("OK", palette.GOOD),
    PlanStatus.NO_SAFE_CANDIDATE: ("no safe candidate: stopping", palette.BAD),
    PlanStatus.STALE_CLOUD: ("no cloud", palette.WARNING),
}
_SLOW = 1.1
"""Factor of delay from which a flight is reported as slow."""
_SETTLE_TIME = 1.0
"""Time that `Frame.rate` averages over [s]. Within it, the rate still includes a pause or another speed."""
_SMALL_DISTURBANCE = 0.05
"""Least disturbance that is shown [m/s^2]."""
_SMALL_DRAG = 0.01
"""Least drag that is shown [1/s]."""


class StatusPanel(Panel):
    """Status, figures, stage times, the charts of the layers, and the legend."""

    def create(self, gui: viser.GuiApi) -> None:
        self.html = gui.add_html("")
        """State and figures."""
        self.costs = gui.add_html("")
        """Charts of the layers."""
        self._playback: tuple[bool, float] | None = None
        self._playback_since = 0.0

    def create_details(self, gui: viser.GuiApi) -> None:
        """Create the times of the stages and the legend, in the open container. They are tall."""
        self.stages = gui.add_html("")
        self.key = gui.add_html("")

    def update_without_frame(self) -> list[Change]:
        return [(self.html, "content", markup.block(markup.text(self.session.waiting_message)))]

    def update(self, frame: Frame) -> list[Change]:
        return [
            (self.html, "content", markup.block(self._state(frame), _live(frame), _figures(frame), _estimates(frame))),
            (self.costs, "content", markup.block(*self._charts(frame))),
            (self.stages, "content", markup.block(_stages(frame))),
            (self.key, "content", markup.legend(legend_entries(self.page.layers.values(), frame))),
        ]

    def _state(self, frame: Frame) -> str:
        recorded = frame.recorded_plan
        status = PlanStatus(int(np.asarray(frame.plan.status))) if recorded is None else recorded.status
        pills = [markup.pill(*_STATUS[status])]
        if frame.outcome is not None:
            color = palette.OUTCOMES.get(frame.outcome, palette.WARNING)
            pills.append(markup.pill(frame.outcome.replace("_", " "), color))
        elif not self.session.playing:
            pills.append(markup.pill("paused", palette.MUTED))
        if delay := self._delay(frame):
            pills.append(markup.muted(delay))
        sentences = list(frame.source.notices)
        if frame.explanation and not any(frame.explanation in sentence for sentence in sentences):
            sentences.append(frame.explanation)
        notices = "".join(
            f'<div style="color:{markup.ink(palette.WARNING)};margin-top:3px">{markup.text(sentence)}</div>'
            for sentence in sentences
        )
        name = f"<b>{markup.text(frame.source.name)}</b> {markup.muted(f'{frame.time:.2f} s')}"
        flown = "" if recorded is None else f'<div style="margin-top:3px">{_recorded(recorded)}</div>'
        return f'<div style="margin-bottom:5px">{name}</div>{"".join(pills)}{flown}{notices}'

    def _delay(self, frame: Frame) -> str:
        """Return the effect of late ticks: a recording and a drone drop some, a simulated flight runs slower."""
        if frame.dropped_ticks:
            return f"{frame.dropped_ticks} ticks dropped"
        playback = playing, speed = self.session.playing, self.session.speed
        if playback != self._playback:
            self._playback, self._playback_since = playback, time.monotonic()
        is_simulated = frame.source.closed_loop and self.session.controls is not None
        if not (is_simulated and playing and frame.rate) or time.monotonic() - self._playback_since < _SETTLE_TIME:
            return ""
        slower = speed / (frame.rate * frame.source.period)
        if slower < _SLOW:
            return ""
        return f"{slower:.1f} times slower than {'real time' if speed == 1.0 else 'requested'}"

    def _charts(self, frame: Frame) -> list[str]:
        charts = [chart for layer in self.page.layers.values() if (chart := layer.chart(frame)) is not None]
        return [markup.heading(chart.label, chart.summary) + markup.bars(chart.bars) for chart in charts]


def _recorded(plan: RecordedPlan) -> str:
    best = plan.best
    return markup.text(
        f"recorded plan: instance {best} ({plan.kinds[best]}), S2 {cost_text(plan.stage2_cost[best])}, "
        f"clearance of the plan {plan.clearance[best]:.2f} m"
    )


def _live(frame: Frame) -> str:
    """Return the heading above a live plan that was not flown; empty for a simulated flight."""
    is_flown = frame.source.recorded_plan is None
    return "" if is_flown else f'<div style="font-weight:600">{markup.text("live planner on this cloud")}</div>'


def _figures(frame: Frame) -> str:
    state = frame.observation.actual_state
    position = np.asarray(state.position)
    goal_distance = np.linalg.norm(np.asarray(frame.observation.goal.position) - position)
    count = len(frame.observation.points)
    points = f"{count // 1000}k" if count >= 10_000 else f"{count}"
    plan, kept = ensemble(frame.plan), ("points", points, "")
    if plan is not None:
        # Continued surfaces count as filtered points for the planner, but no beam has hit them.
        continued = 0 if plan.continued_cells is None else np.count_nonzero(plan.continued_cells)
        kept = ("filtered points", f"{len(plan.filtered_points) - continued}", f"/{points}")
    return markup.metrics(
        [
            ("speed", f"{np.linalg.norm(np.asarray(state.velocity)):.1f}", "m/s"),
            _height(frame, float(position[2])),
            ("distance to goal", f"{goal_distance:.1f}", "m"),
            ("clearance of the plan", clearance_text(frame), "m"),
            kept,
            ("plan", f"{frame.timings_ms.get('plan', 0.0):.1f}", "ms"),
        ]
    )


def clearance_text(frame: Frame) -> str:
    """Return the smallest clearance of the chosen path [m], which AERO-MPPI measures up to costs.distance_max."""
    clearance = float(frame.plan.clearance[int(frame.plan.best)].min())
    reach = frame.config.costs.distance_max if isinstance(frame.config, PlannerConfig) else np.inf
    return "?" if np.isnan(clearance) else f"≥{reach:.2f}" if clearance >= reach - 1e-4 else f"{clearance:.2f}"


def _height(frame: Frame, z: float) -> tuple[str, str, str]:
    """Return the height above the ground where that is known, and otherwise z, whose origin the label names."""
    ground = frame.observation.ground_height
    if ground is not None and np.isfinite(ground):
        return "height", f"{z - ground:.1f}", "m"
    return "z" if frame.source.times is None else "z from first pose", f"{z:.1f}", "m"


def _estimates(frame: Frame) -> str:
    """Return what the planner counts on besides thrust and gravity; empty where there is none to speak of."""
    plan = ensemble(frame.plan)
    if plan is None:
        return ""
    disturbance = 0.0 if plan.disturbance is None else float(np.linalg.norm(plan.disturbance))
    drag = 0.0 if plan.drag is None else float(plan.drag)
    if disturbance < _SMALL_DISTURBANCE and drag < _SMALL_DRAG:
        return ""
    return markup.heading("drag, disturbance", f"{drag:.2f} 1/s, {disturbance:.1f} m/s²")


def _stages(frame: Frame) -> str:
    stages = {name: ms for name, ms in frame.plan.stage_ms.items() if name != "total"}
    colors = palette.as_rgb(palette.SHARES[np.linspace(0, len(palette.SHARES) - 1, max(len(stages), 2)).astype(int)])
    parts = [(name, ms, color) for (name, ms), color in zip(stages.items(), colors, strict=False)]
    total = frame.timings_ms.get("plan", 0.0)
    heading = markup.heading("plan", f"{total:.1f} ms = {1e3 / max(total, 1e-3):.0f} Hz")
    return heading + markup.stacked(parts, "ms")
