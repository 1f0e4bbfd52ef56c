"""The accumulated cloud that the planner gets."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorScale, Layer, Option
from aero_viz.session.frame import Frame

__all__ = ["CloudLayer"]

_MOST_POINTS = 24_000
_STEP = 4096
"""The size of the buffer is a multiple of this, so that it seldom changes."""


class CloudLayer(Layer):
    """LiDAR points, thinned to 24 000 and coloured by height or range."""

    name, title = "cloud", "LiDAR cloud"

    def create(self, scene: viser.SceneApi) -> None:
        self.color_by = Option("Colour by", lambda _: ("height", "range"), "height")
        self.options = (self.color_by,)
        self._scale: ColorScale | None = None
        self._shown: tuple[object, str] | None = None
        self._node = scene.add_point_cloud(
            "/cloud/points", np.zeros((_STEP, 3), np.float32), np.zeros((_STEP, 3), np.uint8),
            point_size=0.016, point_shape="circle", point_shading="flat", precision="float32", visible=False,
        )  # fmt: skip

    def update(self, frame: Frame) -> list[Change]:
        cloud = frame.observation.points
        if self._shown is not None and self._shown[0] is cloud and self._shown[1] == self.color_by.value:
            return []
        self._shown = (cloud, self.color_by.value)
        points = _thinned(cloud)
        if not len(points):
            return [(self._node, "visible", False)]
        if self.color_by.value == "range":
            origin = np.asarray(frame.observation.state.position, dtype=np.float32)
            ranges = np.linalg.norm(points - origin, axis=1)
            reach = frame.config.partition.range_max
            colors = palette.colorize(ranges, 0.0, reach, palette.NEAR_TO_FAR)
            self._scale = ColorScale("cloud: range", "0 m", f"{reach:g} m and more", palette.NEAR_TO_FAR)
        else:
            low, high = np.percentile(points[::16, 2], (2.0, 98.0))
            high = max(high, low + 2.0)
            colors = palette.colorize(points[:, 2], low, high, palette.VIRIDIS[20:])
            self._scale = ColorScale("cloud: height", f"{low + 0.05:.1f} m", f"{high:.1f} m", palette.VIRIDIS[20:])
        return [(self._node, "points", points), (self._node, "colors", colors), (self._node, "visible", True)]

    def legend(self, frame: Frame) -> list[ColorScale]:
        return [] if self._scale is None else [self._scale]


def _thinned(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return at most 24 000 finite points from all over the cloud, padded with the last one to a multiple of 4096."""
    step = -(-len(cloud) // _MOST_POINTS)
    points = cloud[:: max(step, 1)]
    finite = np.isfinite(points[:, 0])
    if not finite.all():
        points = points[finite]
    missing = -len(points) % _STEP if len(points) else 0
    return np.concatenate((points, np.repeat(points[-1:], missing, axis=0))) if missing else points
