"""Rollouts of the pinned configuration, A, for the same tick."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines, relative_to_drone
from aero_viz.session.frame import Frame

_COLOR = palette.unmapped(palette.GHOST)


class AlternativeLayer(Layer):
    """Rollouts of configuration A in the colour of the ghost: all of them thin, the chosen one thick."""

    name, title = "alternative", "Rollouts of configuration A"
    keys = (ColorKey("rollouts of configuration A", palette.GHOST),)

    def create(self, scene: viser.SceneApi) -> None:
        self.available = False
        self._drone = scene.add_frame("/alternative/drone", show_axes=False)
        self._all = Lines(scene, "/alternative/drone/all", thickness=1.2, capacity=512)
        self._chosen = Lines(scene, "/alternative/drone/chosen", thickness=4.5, capacity=32)

    def update(self, frame: Frame) -> list[Change]:
        past = None if self.history is None else self.history.past()
        self.available = past is not None and past.pinned is not None
        a = None if past is None else past.alternative_to(frame)
        if a is None:
            nothing = np.zeros((0, 2, 3))
            return [*self._all.show(nothing, _COLOR), *self._chosen.show(nothing, _COLOR)]
        best = int(a.plan.best)
        positions = relative_to_drone(a.plan.positions, frame)
        return [
            (self._drone, "position", frame.drone_position),
            *self._all.show(polylines(np.delete(positions, best, axis=0)), _COLOR),
            *self._chosen.show(polylines(positions[best]), _COLOR),
        ]
