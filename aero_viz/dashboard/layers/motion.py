"""Dynamic obstacles: those that the planner tracks and predicts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner.stages.moving_obstacles.tracks import GROWTH
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame

_MOVING = palette.unmapped(palette.MOVING)
_ANGLE = 2.0 * np.pi * np.arange(33) / 32


class MotionLayer(Layer):
    """A ring around each dynamic obstacle at the height of the drone, and where it will be at the end of the plan."""

    name, title = "motion", "Dynamic obstacles"
    needs = "tracks"
    keys = (ColorKey("dynamic obstacles, predicted", palette.MOVING),)

    def create(self, scene: viser.SceneApi) -> None:
        self._lines = Lines(scene, "/motion/lines", thickness=2.0, capacity=512)

    def update(self, frame: Frame) -> list[Change]:
        return self._lines.show(_rings(frame), _MOVING)

    def legend(self, frame: Frame) -> Sequence[ColorKey]:
        return self.keys if len(_rings(frame)) else ()


def _rings(frame: Frame) -> NDArray[np.float32]:
    """Return the segments of the rings and of the line between the two rings of each obstacle [m], shape [n, 2, 3]."""
    plan, config = ensemble(frame.plan), frame.config
    moving = None if plan is None else plan.moving
    if moving is None or not len(moving.radii):
        return np.zeros((0, 2, 3), np.float32)
    height = np.asarray(frame.observation.actual_state.position)[2]
    circle = np.stack((np.cos(_ANGLE), np.sin(_ANGLE)), axis=-1)
    rings = []
    for time in (0.0, config.horizon):
        radii = moving.radii + time * float(GROWTH)
        rings.append((moving.positions + time * moving.velocities)[:, None] + radii[:, None, None] * circle)
    ways = np.stack((moving.positions, moving.positions + config.horizon * moving.velocities), axis=1)
    segments = [np.stack((ring[:, :-1], ring[:, 1:]), axis=2).reshape(-1, 2, 2) for ring in rings]
    flat = np.concatenate((*segments, ways))
    return np.concatenate((flat, np.full((*flat.shape[:2], 1), height)), axis=-1).astype(np.float32)
