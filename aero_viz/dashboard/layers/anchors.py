"""Anchors and the guides that lead to them."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, full_plan, polylines, relative_to_drone
from aero_viz.session.frame import Frame

_RAMP = palette.unmapped((palette.ENDPOINT, palette.ANCHOR))
_GUIDE = palette.unmapped(palette.GUIDE)


class AnchorLayer(Layer):
    """Initial endpoints, refined anchors, and a line from each endpoint to its anchor."""

    name, title = "anchors", "Endpoints and anchors"
    needs = "anchors"
    keys = (ColorKey("initial endpoints", palette.ENDPOINT), ColorKey("refined anchors", palette.ANCHOR))

    def create(self, scene: viser.SceneApi) -> None:
        self._drone = scene.add_frame("/anchors/drone", show_axes=False)
        self._initial, self._refined = (
            scene.add_point_cloud(
                f"/anchors/drone/{name}", np.zeros((1, 3), np.float32), color, point_size=size, point_shape="circle",
                precision="float32", point_shading="flat",
            )
            for name, color, size in (("initial", palette.ENDPOINT, 0.05), ("refined", palette.ANCHOR, 0.08))
        )  # fmt: skip
        self._moves = Lines(scene, "/anchors/drone/moves", thickness=1.4)

    def update(self, frame: Frame) -> list[Change]:
        count = frame.config.anchor_count
        initial = relative_to_drone(full_plan(frame).initial_endpoints[:count], frame)
        refined = relative_to_drone(full_plan(frame).anchors[:count], frame)
        return [
            (self._drone, "position", frame.drone_position),
            (self._initial, "points", initial),
            (self._refined, "points", refined),
            *self._moves.show(np.stack((initial, refined), axis=1), _RAMP),
        ]


class GuideLayer(Layer):
    """Quintic guides to the anchors."""

    name, title = "guides", "Guides"
    needs = "guides"
    keys = (ColorKey("guides", palette.GUIDE),)

    def create(self, scene: viser.SceneApi) -> None:
        self._drone = scene.add_frame("/guides/drone", show_axes=False)
        self._lines = Lines(scene, "/guides/drone/lines", thickness=1.2, capacity=512)

    def update(self, frame: Frame) -> list[Change]:
        guides = relative_to_drone(full_plan(frame).guides[: frame.config.anchor_count], frame)
        return [(self._drone, "position", frame.drone_position), *self._lines.show(polylines(guides), _GUIDE)]
