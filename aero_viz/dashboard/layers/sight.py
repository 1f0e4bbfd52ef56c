"""Layer of the view at the height of the drone: space occluded by surfaces, and space assumed to be free."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner.stages.stop_proof.stops import ALWAYS_SEEN
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, full_plan
from aero_viz.dashboard.layers.cells import cells_of, is_unseen
from aero_viz.session.frame import Frame

_SECTORS = 480
"""Sectors of a turn, three for each column of cells by default."""
_NEAREST = float(ALWAYS_SEEN)
_ANGLES = 2.0 * np.pi * np.arange(_SECTORS + 1) / _SECTORS
_BORDERS = np.stack((np.cos(_ANGLES), np.sin(_ANGLES), np.zeros_like(_ANGLES)), axis=-1)
_MIDDLES = _BORDERS[1:] + _BORDERS[:-1]
_FACES = (4 * np.arange(_SECTORS)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.uint32)


class OccludedSpaceLayer(Layer):
    """A horizontal cut at the height of the drone, up to the maximum range.

    Space behind the nearest point of a cell is occluded, whether the point was measured or continued: a backup stop may
    not lie there. Space in unseen cells is assumed to be free, up to a continued surface.
    """

    name, title, on_by_default = "occluded_space", "Occluded space", False
    needs = "cells"

    def create(self, scene: viser.SceneApi) -> None:
        self._drone = scene.add_frame("/occluded_space/drone", show_axes=False)
        self.occluded, self.assumed = (
            scene.add_mesh_simple(
                f"/occluded_space/drone/{name}", np.zeros((4 * _SECTORS, 3), np.float32), _FACES, color=color,
                opacity=opacity, side="double", flat_shading=True, cast_shadow=False, receive_shadow=False,
            )
            for name, color, opacity in (("occluded", palette.OCCLUDED, 0.5), ("assumed", palette.UNSEEN, 0.35))
        )  # fmt: skip

    def update(self, frame: Frame) -> list[Change]:
        state, reach = frame.observation.state, frame.config.farthest_range
        cells = cells_of(_MIDDLES, state.quaternion, full_plan(frame).fine_range.shape)
        seen = np.maximum(full_plan(frame).fine_range.ravel()[cells], _NEAREST)
        assumed = np.where(is_unseen(frame)[cells, 0], seen, _NEAREST)
        return [
            (self._drone, "position", np.asarray(state.position)),
            (self.occluded, "vertices", _rings(seen, np.full(_SECTORS, reach))),
            (self.assumed, "vertices", _rings(np.full(_SECTORS, _NEAREST), assumed)),
        ]

    def legend(self, frame: Frame) -> list[ColorKey]:
        config = frame.config
        is_avoided = "stop_proof" in config.stages.names and config.stop_proof.prove_stop
        rule = "no backup stop lies there" if is_avoided else "behind what is seen"
        return [ColorKey(f"occluded: {rule}", palette.OCCLUDED), ColorKey("not seen: assumed free", palette.UNSEEN)]


def _rings(inner: NDArray[np.floating], outer: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the corners of all sectors between two radii [m] around the origin, shape [4 * sectors, 3]."""
    near, far = inner[:, None], np.maximum(inner, outer)[:, None]
    left, right = _BORDERS[1:], _BORDERS[:-1]
    return np.stack((near * right, far * right, far * left, near * left), axis=1).reshape(-1, 3).astype(np.float32)
