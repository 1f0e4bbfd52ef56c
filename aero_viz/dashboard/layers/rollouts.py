"""The optimised rollouts of Stage II."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner import Plan
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, Layer, Lines, polylines
from aero_viz.session.frame import Frame

__all__ = ["RolloutLayer", "cost_scale"]

_COST, _CHOSEN = palette.unmapped(palette.COST), palette.unmapped(palette.CHOSEN)


def cost_scale(plan: Plan, *, by: str = "rank") -> NDArray[np.float64]:
    """Return the place of each instance between the worst (0) and the best (1) Stage II cost, shape [M].

    Costs span from tens to 1e7 with collisions, and differ by a per mille without: "rank" spaces them evenly,
    "log cost" by log(1 + S2 - min S2).
    """
    cost = np.asarray(plan.stage2_cost, dtype=np.float64)
    if by == "rank":
        place = np.argsort(np.argsort(cost, kind="stable"), kind="stable").astype(np.float64)
    else:
        place = np.log1p(cost - cost.min())
    return 1.0 - place / max(place.max(), 1e-9)


class RolloutLayer(Layer):
    """All instances coloured by cost, bright is good; the chosen one is thick and green."""

    name, title = "rollouts", "Optimised rollouts"
    colors = ("rank", "log cost")

    def create(self, scene: viser.SceneApi) -> None:
        self.color_by = self.colors[0]
        self._all = Lines(scene, "/rollouts/all", thickness=2.2, capacity=512)
        self._chosen = Lines(scene, "/rollouts/chosen", thickness=5.0, capacity=32)

    def update(self, frame: Frame) -> list[Change]:
        plan = frame.plan
        best = int(plan.best)
        others = np.delete(plan.positions, best, axis=0)
        paint = palette.colorize(np.delete(cost_scale(plan, by=self.color_by), best), 0.0, 1.0, _COST)
        paint = np.repeat(paint, others.shape[1] - 1, axis=0)[:, None, :]
        return [
            *self._all.show(polylines(others), paint),
            *self._chosen.show(polylines(plan.positions[best]), _CHOSEN),
        ]
