"""The selected instance, and the selected point or cell."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines, relative_to_drone
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame

_COLOR = palette.unmapped(palette.SELECTED)


class SelectionLayer(Layer):
    """Rollout, guide and anchor of the selected instance, and the selected point, in magenta."""

    name, title = "selection", "Selection"
    keys = (ColorKey("selected", palette.SELECTED),)

    def create(self, scene: viser.SceneApi) -> None:
        self.instance: int | None = None
        """Selected instance."""
        self.point: NDArray[np.float64] | None = None
        """Selected point of the cloud [m], shape [3], world frame."""
        self._drone = scene.add_frame("/selection/drone", show_axes=False)
        self._rollout = Lines(scene, "/selection/drone/rollout", thickness=6.0, capacity=32)
        self._guide = Lines(scene, "/selection/drone/guide", thickness=2.5, capacity=32)
        self._marks = [
            scene.add_icosphere(f"/selection/{name}", radius=radius, color=palette.SELECTED, visible=False)
            for name, radius in (("drone/anchor", 0.12), ("point", 0.06))
        ]

    def update(self, frame: Frame) -> list[Change]:
        plan, m, empty = frame.plan, self.instance, np.zeros((0, 2, 3))
        is_there = m is not None and m < len(plan.kinds)
        rollout = plan.positions[m] if is_there else None
        full = ensemble(plan) if is_there else None
        guide = None if full is None else full.guides[m]
        anchor, point = self._marks
        changes = [
            (self._drone, "position", frame.drone_position),
            *self._rollout.show(empty if rollout is None else polylines(relative_to_drone(rollout, frame)), _COLOR),
            *self._guide.show(empty if guide is None else polylines(relative_to_drone(guide, frame)), _COLOR),
            (anchor, "visible", full is not None),
            (point, "visible", self.point is not None),
        ]
        if full is not None:
            changes.append((anchor, "position", full.anchors[m] - frame.drone_position))
        if self.point is not None:
            changes.append((point, "position", self.point))
        return changes

    def legend(self, frame: Frame) -> list[ColorKey]:
        return [] if self.instance is None and self.point is None else list(self.keys)
