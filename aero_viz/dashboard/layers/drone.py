"""The drone and its trail."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines
from aero_viz.dashboard.quadrotor import quadrotor
from aero_viz.session.frame import Frame

__all__ = ["DroneLayer", "TrailLayer"]

_TRAIL_SEGMENTS = 512
_TRAIL = palette.unmapped(palette.TRAIL)


class DroneLayer(Layer):
    """Quadrotor at its true pose, or at the recorded one."""

    name, title = "drone", "Drone"
    keys = (ColorKey("drone", palette.DRONE),)

    def create(self, scene: viser.SceneApi) -> None:
        self.pose = scene.add_frame("/drone/body", show_axes=False, visible=False)
        for name, (mesh, color, opacity) in quadrotor().items():
            scene.add_mesh_simple(
                f"/drone/body/{name}",
                mesh.vertices,
                mesh.faces,
                color=color,
                opacity=opacity,
                flat_shading=True,
                side="double",
            )

    def update(self, frame: Frame) -> list[Change]:
        state = frame.observation.actual_state
        return [
            (self.pose, "position", np.asarray(state.position, dtype=np.float64)),
            (self.pose, "wxyz", np.asarray(state.quaternion, dtype=np.float64)),
            (self.pose, "visible", True),
        ]


class TrailLayer(Layer):
    """Path flown so far, thinned to 512 segments."""

    name, title = "trail", "Flown trail"
    keys = (ColorKey("flown trail", palette.TRAIL),)

    def create(self, scene: viser.SceneApi) -> None:
        self._lines = Lines(scene, "/trail/line", thickness=3.0, capacity=_TRAIL_SEGMENTS)

    def update(self, frame: Frame) -> list[Change]:
        trail = frame.trail
        # With steps that are powers of two, vertices stay in place while the trail grows.
        step = 1
        while len(trail) > (_TRAIL_SEGMENTS - 1) * step:
            step *= 2
        vertices = np.concatenate((trail[::step], trail[-1:]))
        return self._lines.show(polylines(vertices), _TRAIL)
