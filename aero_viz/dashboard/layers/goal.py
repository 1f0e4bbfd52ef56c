"""The goal."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, apply
from aero_viz.session.frame import Frame


class GoalLayer(Layer):
    """Goal of the flight: a ball in a ring."""

    name, title = "goal", "Goal"
    keys = (ColorKey("goal", palette.GOAL),)

    def create(self, scene: viser.SceneApi) -> None:
        self.pose = scene.add_frame("/goal/pose", show_axes=False, visible=False)
        scene.add_icosphere("/goal/pose/ball", radius=0.3, color=palette.GOAL, subdivisions=3)
        angle = 2.0 * np.pi * np.arange(49) / 48
        ring = 0.8 * np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=1)
        segments = np.stack((ring[:-1], ring[1:]), axis=1)
        apply(Lines(scene, "/goal/pose/ring", thickness=3.0).show(segments, palette.unmapped(palette.GOAL)))

    def update(self, frame: Frame) -> list[Change]:
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        return [(self.pose, "position", goal), (self.pose, "visible", True)]
