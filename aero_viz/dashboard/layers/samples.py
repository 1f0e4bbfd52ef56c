"""The samples of Stage I of one instance."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, Layer, Lines, polylines
from aero_viz.session.frame import Frame

__all__ = ["SampleLayer"]

BEST = -1
_RANKS = palette.unmapped(palette.VIRIDIS)


class SampleLayer(Layer):
    """The K rollouts of one instance, coloured by the rank of their cost; needs frames that carry samples."""

    name, title, on = "samples", "Stage I samples", False

    def create(self, scene: viser.SceneApi) -> None:
        self.instance = BEST
        """Which instance is shown; BEST follows the chosen one."""
        self._lines = Lines(scene, "/samples/lines", thickness=1.0, capacity=4096)

    def update(self, frame: Frame) -> list[Change]:
        plan = frame.plan
        if plan.samples is None:
            return self._lines.show(np.zeros((0, 2, 3)), _RANKS[0])
        instance = int(plan.best) if self.instance == BEST else min(self.instance, len(plan.samples) - 1)
        rollouts = plan.samples[instance]
        rank = np.argsort(np.argsort(plan.stage1_cost[instance]))
        paint = palette.colorize(-rank, -1.25 * len(rank), 0.0, _RANKS)
        return self._lines.show(polylines(rollouts), np.repeat(paint, rollouts.shape[1] - 1, axis=0)[:, None, :])
