"""The accumulated cloud that the planner gets."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.sweeps import Sweeps
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorScale, Layer, Option, headroom, view_targets
from aero_viz.scenes import SightLines, World
from aero_viz.session.frame import Frame

_MOST_POINTS = 24_000
_STEP = 4096
"""The size of the buffer is a multiple of this, so that it rarely changes."""


_ROUGHNESS = 0.1
"""Scatter of the points of a ceiling [m]."""
_REACH = 20.0
"""Range of the last colour for planners that do not say how far they look [m]."""


class CloudLayer(Layer):
    """LiDAR points, thinned to 24 000 and coloured by height or range."""

    name, title = "cloud", "LiDAR cloud"

    def create(self, scene: viser.SceneApi) -> None:
        self.color_by = Option("Colour by", lambda _: ("height", "range"), "height")
        self.options = (self.color_by,)
        self._scale: ColorScale | None = None
        self._shown: tuple[object, ...] | None = None
        self._sight: tuple[World, SightLines] | None = None
        self.node = scene.add_point_cloud(
            "/cloud/points", np.zeros((_STEP, 3), np.float32), np.zeros((_STEP, 3), np.uint8),
            point_size=0.016, point_shape="circle", point_shading="flat", precision="float32", visible=False,
        )  # fmt: skip

    def update(self, frame: Frame) -> list[Change]:
        cloud, top = frame.observation.points, self._top(frame)
        if self._shown is not None and self._shown[0] is cloud and self._shown[1:] == (self.color_by.value, top):
            return []
        self._shown = (cloud, self.color_by.value, top)
        points = _padded(self._unobstructed(self.thinned(frame.observation.sweeps), frame, top))
        if not len(points):
            return [(self.node, "visible", False)]
        if self.color_by.value == "range":
            origin = np.asarray(frame.observation.state.position, dtype=np.float32)
            ranges = np.linalg.norm(points - origin, axis=1)
            reach = frame.config.farthest_range if isinstance(frame.config, PlannerConfig) else _REACH
            colors = palette.colorize(ranges, 0.0, reach, palette.NEAR_TO_FAR)
            self._scale = ColorScale("cloud: range", "0 m", f"{reach:g} m and more", palette.NEAR_TO_FAR)
        else:
            low, high = np.percentile(points[::16, 2], (5.0, 95.0))
            high = max(high, low + 0.5)
            colors = palette.colorize(points[:, 2], low, high, palette.HEIGHT)
            self._scale = ColorScale(
                "cloud: height", f"{low + 0.05:.1f} m and less", f"{high:.1f} m and more", palette.HEIGHT
            )
        return [(self.node, "points", points), (self.node, "colors", colors), (self.node, "visible", True)]

    def thinned(self, cloud: Sweeps) -> NDArray[np.float32]:
        """Return the points to draw [m], shape [n, 3]: at most 24 000 finite ones from all over the cloud."""
        points = cloud.points[:: max(-(-len(cloud.points) // _MOST_POINTS), 1)]
        finite = np.isfinite(points[:, 0])
        return points if finite.all() else points[finite]

    def _top(self, frame: Frame) -> float:
        """Return the height above which points would hide the drone: of the ceiling between it and a camera [m]."""
        heights, world = [headroom(self.eyes, frame)], frame.moving_world
        if world is not None:
            if self._sight is None or self._sight[0] is not world:  # what lies flat does not move
                self._sight = world, SightLines(world)
            heights += [self._sight[1].ceiling(eye, frame.drone_position) for eye in self.eyes]
        return min((height for height in heights if height is not None), default=np.inf)

    def _unobstructed(self, points: NDArray[np.float32], frame: Frame, top: float) -> NDArray[np.float32]:
        """Return the points without those between a camera and the drone or its plan, and below a height [m]."""
        places, margins = view_targets(frame)
        keep = points[:, 2] < top - _ROUGHNESS
        for eye in self.eyes:
            for place, margin in zip(places, margins, strict=True):
                line, length = place - eye, float(np.linalg.norm(place - eye))
                if length <= margin:
                    continue
                direction = (line / length).astype(np.float32)
                offset = points - eye.astype(np.float32)
                along = offset @ direction
                across = np.einsum("ij,ij->i", offset, offset) - along**2
                keep &= (along < 0.0) | (along > length - margin) | (across > margin**2)
        return points if keep.all() else points[keep]

    def legend(self, frame: Frame) -> list[ColorScale]:
        return [] if self._scale is None else [self._scale]


def _padded(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the points, padded with the last one to a multiple of 4096."""
    missing = -len(points) % _STEP if len(points) else 0
    return np.concatenate((points, np.repeat(points[-1:], missing, axis=0))) if missing else points
