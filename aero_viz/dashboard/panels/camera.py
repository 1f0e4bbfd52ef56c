"""Where the viewers look from."""

from __future__ import annotations

import time

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source

__all__ = ["FIELD_OF_VIEW", "VIEWS", "CameraPanel", "orientation", "view"]

FIELD_OF_VIEW = float(np.radians(58.0))
"""From top to bottom of the picture [rad]."""
VIEWS = ("follow", "top", "side")
_OFFSETS = {"follow": (-5.2, 0.0, 2.3), "top": (-0.01, 0.0, 24.0), "side": (1.5, -9.0, 1.0)}
_AHEAD = 1.6
_SETTLE = 1.5
"""A page that has just been opened still moves its camera by itself for about this long [s]."""


def view(
    name: str, position: NDArray[np.float64], goal: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position and look-at [m], each shape [3], of a camera at a drone at `position` that heads for `goal`."""
    heading = np.arctan2(*(goal - position)[1::-1])
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
    target = position + turn @ (_AHEAD, 0.0, 0.0)
    return target + turn @ np.array(_OFFSETS[name]) - turn @ (_AHEAD, 0.0, 0.0), target


class CameraPanel(Panel):
    """Follow keeps the distance and direction that the viewer has chosen; free leaves the camera alone.

    Another source brings every camera to where it starts.
    """

    def create(self, gui: viser.GuiApi) -> None:
        self._mode = "follow"
        self._settled: dict[int, float] = {}
        self.page.server.initial_camera.fov = FIELD_OF_VIEW
        modes = gui.add_button_group(
            "Camera", ("follow", "top", "side", "free"), hint="Orbit and zoom with the mouse in every one of them."
        )

        @modes.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._mode = modes.value
            if self._mode in VIEWS:
                self._settled.clear()
            else:  # whoever looks on stays there, also who was just on the way to another view
                self._settled = dict.fromkeys(self._settled, -np.inf)
            self.page.refresh()

    def enter(self, source: Source) -> list[Change]:
        self._settled.clear()
        return []

    def follow(self, frame: Frame) -> list[Change]:
        """Return the changes that keep the cameras with the drone; for every frame shown."""
        state = frame.observation.actual_state
        position = np.asarray(state.position, dtype=np.float64)
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        start, target = view(self._mode if self._mode in VIEWS else "follow", position, goal)
        changes: list[Change] = []
        if not self._settled:
            changes += self.begin(start, target)
        for number, client in self.page.server.get_clients().items():
            camera = client.camera
            if time.monotonic() < self._settled.setdefault(number, time.monotonic() + _SETTLE):
                changes += [(camera, "position", start), (camera, "look_at", target)]
            elif self._mode != "free":
                # Moving a camera takes along what it looks at.
                changes.append((camera, "position", target + camera.position - camera.look_at))
        return changes

    def begin(self, position: NDArray[np.float64], look_at: NDArray[np.float64]) -> list[Change]:
        """Return the changes that let pages opened from now on begin here."""
        initial = self.page.server.initial_camera
        return [(initial, "position", position), (initial, "look_at", look_at)]

    def is_settling(self, client: viser.ClientHandle) -> bool:
        """Whether the page is still moving its camera to where it begins."""
        return time.monotonic() < self._settled.get(client.client_id, np.inf)


def orientation(position: NDArray[np.float64], look_at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternion w x y z of a camera, z forward and y down, with the world's z up in the picture."""
    forward = look_at - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([0.0, -1.0, 0.0])
    rotation = np.stack((right, np.cross(forward, right), forward), axis=1)
    return np.asarray(viser.transforms.SO3.from_matrix(rotation).wxyz, dtype=np.float64)
