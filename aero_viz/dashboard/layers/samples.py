"""Stage I samples of one instance."""

from __future__ import annotations

import numpy as np
import viser

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import (
    Change,
    ColorScale,
    Layer,
    Lines,
    Option,
    full_plan,
    polylines,
    relative_to_drone,
)
from aero_viz.session.frame import Frame

_CHOSEN = "the chosen one"
_COLORS = palette.unmapped(palette.COST)


class SampleLayer(Layer):
    """The K Stage I rollouts of one instance, coloured by the rank of their cost."""

    name, title, on_by_default, needs_samples = "samples", "Stage I samples", False, True
    needs = "samples"

    def create(self, scene: viser.SceneApi) -> None:
        self.instance = Option("Instance", _instances, _CHOSEN, hint="Instance whose samples are drawn.")
        self.options = (self.instance,)
        self._drone = scene.add_frame("/samples/drone", show_axes=False)
        self._lines = Lines(scene, "/samples/drone/lines", thickness=1.0, capacity=4096)

    def update(self, frame: Frame) -> list[Change]:
        plan, chosen = full_plan(frame), self.instance.value
        if plan.samples is None:
            return self._lines.show(np.zeros((0, 2, 3)), _COLORS[0])
        instance = int(plan.best) if chosen == _CHOSEN else min(int(chosen.split()[0]), len(plan.samples) - 1)
        rollouts = relative_to_drone(plan.samples[instance], frame)
        rank = np.argsort(np.argsort(plan.stage1_cost[instance]))
        colors = palette.colorize(-rank, -len(rank), 0.0, _COLORS)
        colors = np.repeat(colors, rollouts.shape[1] - 1, axis=0)[:, None, :]
        return [(self._drone, "position", frame.drone_position), *self._lines.show(polylines(rollouts), colors)]

    def legend(self, frame: Frame) -> list[ColorScale]:
        return [ColorScale("samples: rank of the Stage I cost", "worst", "best", palette.COST)]


def _instances(config: DroneConfig) -> tuple[str, ...]:
    kinds = config.kinds if isinstance(config, PlannerConfig) else ()
    return (_CHOSEN, *(f"{i} {kind}" for i, kind in enumerate(kinds)))
