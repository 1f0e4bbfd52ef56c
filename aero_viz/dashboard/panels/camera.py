"""Camera of the page."""

from __future__ import annotations

import time

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

__all__ = ["FIELD_OF_VIEW", "VIEWS", "CameraPanel", "orientation", "view"]

FIELD_OF_VIEW = float(np.radians(58.0))
"""Vertical field of view [rad]."""
VIEWS = ("follow", "top", "side")
_OFFSETS = {"follow": (-5.2, 0.0, 2.3), "top": (-0.01, 0.0, 24.0), "side": (1.5, -9.0, 1.0)}
"""Position of the camera relative to the drone [m], per view; +x points to the goal."""
_TARGET_DISTANCE = 1.6
"""Distance from the drone to the point that the camera looks at, toward the goal [m]."""
_SETTLE_TIME = 1.5
"""Time for which a page that was just opened still moves its camera by itself [s]."""


def view(
    name: str, position: NDArray[np.float64], goal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the camera position and look-at point of a named view.

    Args:
        name: one of `VIEWS`.
        position: position of the drone [m], shape [3], world frame.
        goal: position of the goal [m], shape [3], world frame.

    Returns:
        Position and look-at point [m], each of shape [3], world frame.
    """
    heading = np.arctan2(*(goal - position)[1::-1])
    c, s = np.cos(heading), np.sin(heading)
    rotation = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
    target = position + rotation @ (_TARGET_DISTANCE, 0.0, 0.0)
    return target + rotation @ np.array(_OFFSETS[name]) - rotation @ (_TARGET_DISTANCE, 0.0, 0.0), target


class CameraPanel(Panel):
    """Buttons for the camera mode.

    "follow" keeps the distance and direction that the viewer has chosen; "free" leaves the camera alone. Another source
    moves every camera to its first view.
    """

    def create(self, gui: viser.GuiApi) -> None:
        self._mode = "follow"
        self._settled: dict[int, float] = {}
        self.page.server.initial_camera.fov = FIELD_OF_VIEW
        modes = gui.add_button_group(
            "Camera", ("follow", "top", "side", "free"), hint="Every mode allows orbiting and zooming with the mouse."
        )

        @modes.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._mode = modes.value
            if self._mode in VIEWS:
                self._settled.clear()
            else:  # every camera stays where it is, even while it is still moving to another view
                self._settled = dict.fromkeys(self._settled, -np.inf)
            self.page.refresh()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._settled.clear()
        return []

    def follow(self, frame: Frame) -> list[Change]:
        """Return the changes that keep the cameras with the drone. Called for every frame."""
        state = frame.observation.actual_state
        position = np.asarray(state.position, dtype=np.float64)
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        start, target = view(self._mode if self._mode in VIEWS else "follow", position, goal)
        changes: list[Change] = []
        if not self._settled:
            # The first view of pages that are opened from now on.
            initial = self.page.server.initial_camera
            changes += [(initial, "position", start), (initial, "look_at", target)]
        for number, client in self.page.server.get_clients().items():
            camera = client.camera
            if time.monotonic() < self._settled.setdefault(number, time.monotonic() + _SETTLE_TIME):
                changes += [(camera, "position", start), (camera, "look_at", target)]
            elif self._mode != "free":
                # Moving a camera also moves the point that it looks at.
                changes.append((camera, "position", target + camera.position - camera.look_at))
        return changes

    def is_settling(self, client: viser.ClientHandle) -> bool:
        """Return True while the page still moves its camera to its first view."""
        return time.monotonic() < self._settled.get(client.client_id, np.inf)


def orientation(position: NDArray[np.float64], look_at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the attitude of a camera that looks at a point, world z upward in the picture.

    The quaternion (w, x, y, z) turns the camera frame (z forward, y down) to the world frame.
    """
    forward = look_at - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([0.0, -1.0, 0.0])
    rotation = np.stack((right, np.cross(forward, right), forward), axis=1)
    return np.asarray(viser.transforms.SO3.from_matrix(rotation).wxyz, dtype=np.float64)
