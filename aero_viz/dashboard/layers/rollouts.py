"""Optimised rollouts of Stage II."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner import PlanStatus
from aero_viz.cost_text import cost_text
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import (
    Bar,
    BarChart,
    Change,
    ColorKey,
    ColorScale,
    Layer,
    Lines,
    Option,
    polylines,
    relative_to_drone,
)
from aero_viz.planners.plan import Plan, ensemble
from aero_viz.session.frame import Frame
from aero_viz.session.safety import known_safe

_COST, _CHOSEN = palette.unmapped(palette.COST), palette.unmapped(palette.CHOSEN)


def cost_scale(plan: Plan, *, by: str = "rank") -> NDArray[np.float64]:
    """Return the place of each instance between the worst (0) and the best (1) Stage II cost, shape [M].

    Costs range from tens to 1e7 with collisions and differ by 0.1 % without. "rank" therefore spaces them evenly; "log
    cost" spaces them by log(1 + S2 - min S2).
    """
    cost = np.asarray(plan.cost, dtype=np.float64)
    if by == "rank":
        place = np.argsort(np.argsort(cost, kind="stable"), kind="stable").astype(np.float64)
    else:
        place = np.log1p(cost - cost.min())
    return 1.0 - place / max(place.max(), 1e-9)


def cost_name(plan: Plan) -> str:
    """Return what the whole cost of a plan is called."""
    return "Cost" if ensemble(plan) is None else "Stage II cost S2"


class RolloutLayer(Layer):
    """Rollouts of all instances, coloured by cost: bright is good. The chosen one is thick and green."""

    name, title = "rollouts", "Optimised rollouts"

    def create(self, scene: viser.SceneApi) -> None:
        self.color_by = Option("Colour by", lambda _: ("rank", "log cost"), "rank")
        self.options = (self.color_by,)
        self.selected: int | None = None
        """Instance that is selected."""
        self._drone = scene.add_frame("/rollouts/drone", show_axes=False)
        self._all = Lines(scene, "/rollouts/drone/all", thickness=2.2, capacity=512)
        self._chosen = Lines(scene, "/rollouts/drone/chosen", thickness=5.0, capacity=32)

    def update(self, frame: Frame) -> list[Change]:
        plan = frame.plan
        best = int(plan.best)
        positions = relative_to_drone(plan.positions, frame)
        rejected = np.delete(positions, best, axis=0)
        colors = palette.colorize(np.delete(cost_scale(plan, by=self.color_by.value), best), 0.0, 1.0, _COST)
        colors = np.repeat(colors, rejected.shape[1] - 1, axis=0)[:, None, :]
        return [
            (self._drone, "position", frame.drone_position),
            *self._all.show(polylines(rejected), colors),
            *self._chosen.show(polylines(positions[best]), _CHOSEN),
        ]

    def legend(self, frame: Frame) -> list[ColorKey | ColorScale]:
        cost = frame.plan.cost
        quantity = "rank" if self.color_by.value == "rank" else "logarithm"
        label = f"rollouts: {quantity} of the {'Stage II cost' if ensemble(frame.plan) else 'cost'}"
        return [
            ColorScale(label, f"worst: {cost_text(cost.max())}", f"best: {cost_text(cost.min())}", palette.COST),
            ColorKey("chosen rollout", palette.CHOSEN),
        ]

    def chart(self, frame: Frame) -> BarChart:
        plan, best = frame.plan, int(frame.plan.best)
        scale = cost_scale(plan, by=self.color_by.value)
        colors = palette.as_rgb(palette.colorize(scale, 0.0, 1.0, palette.COST))
        height = 1.0 - 0.9 * cost_scale(plan, by="log cost")
        others = {} if ensemble(plan) is None else {"other terms": plan.cost - sum(plan.costs.values())}
        terms = {**plan.costs, **others}
        clearance, is_faint = plan.clearance.min(axis=1), ~known_safe(frame)
        name = "cost" if ensemble(plan) is None else "S2"
        bars = [
            Bar(
                height=float(height[i]),
                tooltip=f"{i} {kind}: {name} {cost_text(plan.cost[i])} = "
                + " + ".join(f"{term} {cost_text(values[i])}" for term, values in terms.items())
                + ("" if np.isnan(clearance[i]) else f"; clearance of the plan {clearance[i]:.2f} m")
                + _origin(frame, i),
                color=palette.SELECTED if i == self.selected else palette.CHOSEN if i == best else colors[i],
                is_marked=i == best,
                is_faint=bool(is_faint[i]),
            )
            for i, kind in enumerate(plan.kinds)
        ]
        label = f"{cost_name(plan)} (log): shorter is better among safe candidates; faint: unsafe"
        summary = f"chosen: instance {best}, {plan.kinds[best]}{_origin(frame, best)}"
        if plan.status == PlanStatus.NO_SAFE_CANDIDATE:
            summary += "; no candidate is safe" if frame.config.prefers_safe else "; the cheapest candidate is not safe"
        return BarChart(label, summary, bars)


def _origin(frame: Frame, instance: int) -> str:
    """Return where the instance "previous" comes from at the first tick, after a semicolon; empty for all others."""
    is_first = frame.index == 0 and frame.source.times is None
    is_initial = is_first and frame.plan.kinds[instance] == "previous"
    return "; nothing was flown before: straight toward the goal instead" if is_initial else ""
