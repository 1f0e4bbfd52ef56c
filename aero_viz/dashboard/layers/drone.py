"""The drone and its trail."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.history import Past
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines
from aero_viz.dashboard.quadrotor import quadrotor
from aero_viz.session.frame import Frame

_TRAIL_SEGMENTS = 512
_THICKNESS = 3.0
_ROD_COUNT, _ROD_LENGTH = 10, 0.5
"""Number of rods at the end of the trail, and their length [m]."""
_GHOST = palette.unmapped(palette.GHOST)
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
        path = past.ghost[:, -3:]
        differs = [] if past.differs_at is None else np.flatnonzero(past.rows[:, 0] >= past.differs_at - 1e-9)[:1]
        step = -(-len(path) // (_TRAIL_SEGMENTS - 1))
        vertices = np.concatenate((path[::step], path[-1:])).astype(np.float32)
        at = min(int(np.searchsorted(past.ghost[:, 0], frame.time + 1e-9)), len(path)) - 1
        return [
            *self._lines.show(polylines(vertices), _GHOST),
            (self._pose, "position", path[max(at, 0)]),
            (self._pose, "visible", at >= 0),
            *((self._ball, "position", past.rows[row, -3:]) for row in differs),
            (self._ball, "visible", len(differs) > 0),
        ]


def _is_shown(past: Past) -> bool:
    return past.ghost_name != "before" or past.differs_at is not None


class TrailLayer(Layer):
    """Path flown so far, thinned to 512 segments.

    A browser that draws slowly moves nodes at once and redraws lines later. Rods, which are nodes, therefore cover the
    last metres up to the drone.
    """

    name, title = "trail", "Flown trail"
    keys = (ColorKey("flown trail", palette.TRAIL),)

    def create(self, scene: viser.SceneApi) -> None:
        self._lines = Lines(scene, "/trail/line", thickness=_THICKNESS, capacity=_TRAIL_SEGMENTS)
        rod = np.array([[(0.0, 0.0, 0.0), (_ROD_LENGTH, 0.0, 0.0)]], dtype=np.float32)
        self._rods = [
            scene.add_line_segments(
                f"/trail/newest/{i}", rod, palette.TRAIL, thickness=_THICKNESS, thickness_units="screen", visible=False
            )
            for i in range(_ROD_COUNT)
        ]

    def update(self, frame: Frame) -> list[Change]:
        trail = frame.trail
        # With steps that are powers of two, vertices stay in place while the trail grows.
        step = 1
        while len(trail) > (_TRAIL_SEGMENTS - 1) * step:
            step *= 2
        vertices = np.concatenate((trail[::step], trail[-1:]))
        changes = self._lines.show(polylines(vertices), _TRAIL)
        joints = _newest(frame)
        for i, rod in enumerate(self._rods):
            if is_used := i + 1 < len(joints):
                changes += [(rod, "position", joints[i]), (rod, "wxyz", _turned_along(joints[i + 1] - joints[i]))]
            changes.append((rod, "visible", is_used))
        return changes


def _newest(frame: Frame) -> NDArray[np.float64]:
    """Return the ends of the rods on the path flown last, from the drone backward [m], shape [n, 3]."""
    path = np.vstack((frame.drone_position, frame.trail[: -_TRAIL_SEGMENTS - 1 : -1]))
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))
    count = min(int(length[-1] / _ROD_LENGTH), _ROD_COUNT)
    return np.stack([np.interp(_ROD_LENGTH * np.arange(count + 1), length, axis) for axis in path.T], axis=-1)


def _turned_along(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the attitude (w, x, y, z) of a node whose x axis points in a direction."""
    x, y, z = direction / np.linalg.norm(direction)
    attitude = np.array((1.0 + x, 0.0, -z, y)) if x > -0.9999 else np.array((0.0, 0.0, 0.0, 1.0))
    return attitude / np.linalg.norm(attitude)
