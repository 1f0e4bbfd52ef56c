"""The drone and its trail."""

from __future__ import annotations

import numpy as np
import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.history import PLACE, Past
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines
from aero_viz.dashboard.quadrotor import quadrotor
from aero_viz.session.frame import Frame

_TRAIL_SEGMENTS = 512
_GHOST = palette.unmapped(palette.GHOST)
_TRAIL = palette.unmapped(palette.DRONE)


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


class GhostLayer(Layer):
    """The flight of configuration A, or the future that was left when the flight forked.

    Its path, a faint drone at the current time, and a ball where the flight first differs from it.
    """

    name, title = "ghost", "Ghost: A, or before the fork"
    keys = (ColorKey("ghost: A, or the future before the fork", palette.GHOST),)

    def create(self, scene: viser.SceneApi) -> None:
        self.available = False
        self._lines = Lines(scene, "/ghost/line", thickness=2.0, capacity=_TRAIL_SEGMENTS)
        self._pose = scene.add_frame("/ghost/body", show_axes=False, visible=False)
        self._ball = scene.add_icosphere("/ghost/difference", radius=0.09, color=palette.GHOST, visible=False)
        for name, (mesh, _, _) in quadrotor().items():
            scene.add_mesh_simple(
                f"/ghost/body/{name}", mesh.vertices, mesh.faces, color=palette.GHOST, opacity=0.5, flat_shading=True,
                side="double",
            )  # fmt: skip

    def update(self, frame: Frame) -> list[Change]:
        past = None if self.history is None else self.history.past()
        self.available = past is not None and len(past.ghost) > 0 and _is_shown(past)
        if past is None or not self.available:
            nothing = self._lines.show(np.zeros((0, 2, 3)), _GHOST)
            return [*nothing, (self._pose, "visible", False), (self._ball, "visible", False)]
        path = past.ghost[:, PLACE]
        differs = [] if past.differs_at is None else np.flatnonzero(past.rows[:, 0] >= past.differs_at - 1e-9)[:1]
        step = -(-len(path) // (_TRAIL_SEGMENTS - 1))
        vertices = np.concatenate((path[::step], path[-1:])).astype(np.float32)
        at = min(int(np.searchsorted(past.ghost[:, 0], frame.time + 1e-9)), len(path)) - 1
        return [
            *self._lines.show(polylines(vertices), _GHOST),
            (self._pose, "position", path[max(at, 0)]),
            (self._pose, "visible", at >= 0),
            *((self._ball, "position", past.rows[row, PLACE]) for row in differs),
            (self._ball, "visible", len(differs) > 0),
        ]


def _is_shown(past: Past) -> bool:
    return past.ghost_name != "before" or past.differs_at is not None


class TrailLayer(Layer):
    """Path flown so far, thinned to 512 segments."""

    name, title = "trail", "Flown trail"
    keys = (ColorKey("flown trail", palette.DRONE),)

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
