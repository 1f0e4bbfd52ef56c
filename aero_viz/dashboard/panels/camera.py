"""Camera of the page."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import viser
import viser.transforms
from numpy.typing import NDArray

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.outlook import Outlook, Sight, has_hit_ground
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

FIELD_OF_VIEW = float(np.radians(58.0))
"""Vertical field of view [rad]."""
VIEWS = ("follow", "top", "side")
MODES = (*VIEWS, "free")
MODE_CLASS = "aero-camera-"
"""Class of the element before the buttons, followed by the number of the active one, from 1."""
_HINT = (
    "follow, top and side move with the drone and keep the distance and direction that you choose with the mouse; "
    "follow looks past obstacles, top cuts what is above the drone, free stays where it is. Every mode allows orbiting "
    "(left button), panning (right button) and zooming (wheel)."
)
_OFFSETS = {
    "follow": (-5.2, 0.0, 2.3),
    "top": (-0.01, 0.0, 24.0),
    "side": (1.5, -9.0, 1.0),
    "ground": (-0.8, -3.4, 0.6),
}
"""Position of the camera relative to the drone [m], per view; +x points to the goal."""
_TARGET_DISTANCE = 1.6
"""Distance from the drone to the point that the camera looks at, toward the goal [m]. From near, on the ground, the
camera looks at the drone: it would be at the edge of the view, behind a panel."""
_REACHES = (1.0, 0.8, 0.6, 0.45)
"""Distances of a first view from the drone to try in turn, as a share of the full one."""
_CLEARANCE = 0.15
"""Smallest distance of a first view from an obstacle [m]."""
_SETTLE_TIME = 1.5
"""Time for which a page that was just opened still moves its own camera [s]."""


Point = NDArray[np.float64]


def view(name: str, position: Point, goal: Point, *, reach: float = 1.0) -> tuple[Point, Point]:
    """Return the camera position and look-at point of a named view.

    Args:
        name: one of `VIEWS`.
        position: position of the drone [m], shape [3], world frame.
        goal: position of the goal [m], shape [3], world frame.
        reach: factor on the distance from the drone.

    Returns:
        Position and look-at point [m], each of shape [3], world frame.
    """
    heading = np.arctan2(*(goal - position)[1::-1])
    c, s = np.cos(heading), np.sin(heading)
    rotation = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)])
    target = position + rotation @ (0.0 if name == "ground" else _TARGET_DISTANCE, 0.0, 0.0)
    return position + reach * rotation @ np.array(_OFFSETS[name]), target


class Viewpoints:
    """First views of the named cameras, clear of the obstacles of a world."""

    def __init__(self) -> None:
        self.sight = Sight()
        """What is between a camera and the drone."""
        self._outlook, self._source = Outlook(self.sight), None

    def find(self, name: str, frame: Frame) -> tuple[Point, Point]:
        """Return the camera position and look-at point of a named view of `frame`, see `view`.

        "top" is as high as the cloud is wide, at most 24 m. "follow" looks from where no obstacle hides the drone, and
        from the side when it has hit the ground. "side" comes closer to the drone where it would be inside an obstacle
        or behind a wall.
        """
        position = frame.drone_position
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        if name == "top":
            return view(name, position, goal, reach=_width(frame) / _OFFSETS[name][2])
        name = "ground" if name == "follow" and has_hit_ground(frame) else name
        if name != "side":
            eye, target = view(name, position, goal)
            if frame.source is not self._source or name == "ground":
                self._source = frame.source
                self._outlook.reset()
            return position + self._outlook(frame, eye - position), target
        views = [view(name, position, goal, reach=reach) for reach in _REACHES]
        return next((found for found in views if self._is_clear(frame, found[0])), views[0])

    def _is_clear(self, frame: Frame, eye: Point) -> bool:
        if frame.world is None:
            return True
        blocking = self.sight.found(frame, eye, frame.drone_position)
        is_walled = len(blocking["boxes"]) + len(blocking["triangles"]) > 0
        return not is_walled and float(frame.world.distance(eye[None])[0]) > _CLEARANCE


def _width(frame: Frame) -> float:
    """Return the height from which "top" sees nearly the whole cloud [m]."""
    points = frame.observation.points[::64]
    points = points[np.isfinite(points[:, 0])]
    if not len(points):
        return _OFFSETS["top"][2]
    across = points[:, :2] - np.asarray(frame.observation.actual_state.position, dtype=np.float32)[:2]
    half = float(np.percentile(np.linalg.norm(across, axis=1), 90.0))
    return float(np.clip(1.15 * half / np.tan(0.5 * FIELD_OF_VIEW), 5.0, _OFFSETS["top"][2]))


@dataclass(frozen=True, eq=False)
class CameraPlace:
    """Mode and place of a camera; points and directions have the shape [3], world frame."""

    mode: str
    up_direction: Point
    position: Point
    look_at: Point
    target: Point | None
    """Point that it was last moved to look at [m]."""


@dataclass(eq=False)
class _Follower:
    """A camera that follows the drone, as its visitor wants it; offsets are from the drone [m], shape [3]."""

    outlook: Outlook
    wanted: Point | None = None
    given: deque[Point] = field(default_factory=lambda: deque(maxlen=90))
    """Offsets that the camera was given, newest last: what the page tells may be a second old."""

    def place(self, frame: Frame, offset: Point) -> Point:
        """Return where the camera goes from where it is. Whatever it was not given is what its visitor wants."""
        scale = 0.02 * float(np.linalg.norm(offset)) + 0.02
        if self.wanted is None or not any(np.linalg.norm(offset - known) < scale for known in self.given):
            self.wanted = offset
            self.given.clear()
            self.outlook.take(frame)
        goes = self.outlook(frame, self.wanted)
        self.given.append(goes)
        return goes


class CameraPanel(Panel):
    """Buttons for the camera mode, separate for each visitor.

    "follow", "top" and "side" keep the distance and direction that the visitor has chosen with the mouse; "free" leaves
    the camera alone. "follow" turns around an obstacle that would hide the drone for a while. Another source moves
    every camera to its first view, and a drone that hits the ground is seen from the side.
    """

    def create(self, gui: viser.GuiApi) -> None:
        self.eyes: list[Point] = []
        """Positions of all cameras after the last `follow` [m]."""
        self._views = Viewpoints()
        self._modes: dict[int, str] = {}
        self._marks: dict[int, viser.GuiHtmlHandle] = {}
        self._order = gui.add_html("", visible=False).order
        self._settled: dict[int, float] = {}
        self._followers: dict[int, _Follower] = {}
        self._is_on_ground = False
        self._targets: dict[int, Point] = {}
        """Point that each camera was last moved to look at [m]."""
        self.page.server.initial_camera.fov = FIELD_OF_VIEW

    def welcome(self, client: viser.ClientHandle) -> None:
        """Offer a new visitor the modes, and mark the active one."""
        number = client.client_id
        self._marks[number] = client.gui.add_html(_mark(self._mode(number)), order=self._order + 0.2)
        buttons = client.gui.add_button_group("Camera", MODES, hint=_HINT, order=self._order + 0.4)

        @buttons.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.select(client, buttons.value)

    def select(self, client: viser.ClientHandle, mode: str) -> None:
        """Change the mode of one visitor's camera."""
        number = client.client_id
        self._modes[number] = mode
        if (mark := self._marks.get(number)) is not None:
            mark.content = _mark(mode)
        if mode in VIEWS:
            self._settled.pop(number, None)
        else:  # the camera stays where it is, even while it is still moving to another view
            self._settled[number] = -np.inf
        self.page.refresh()

    def copy(self, original: viser.ClientHandle, client: viser.ClientHandle) -> None:
        """Give the camera of one visitor the mode and the place of another's."""
        self.place(client, self.place_of(original))

    def place_of(self, client: viser.ClientHandle) -> CameraPlace:
        """Return the mode and the place of the camera of a visitor."""
        number, seen = client.client_id, client.camera
        return CameraPlace(
            self._mode(number), seen.up_direction, seen.position, seen.look_at, self._targets.get(number)
        )  # fmt: skip

    def place(self, client: viser.ClientHandle, place: CameraPlace) -> None:
        """Give the camera of a visitor a mode and a place."""
        number = client.client_id
        self._modes[number] = place.mode
        self._settled[number] = -np.inf
        if place.target is not None:
            self._targets[number] = place.target
        if (mark := self._marks.get(number)) is not None:
            mark.content = _mark(place.mode)
        with client.atomic():
            client.camera.up_direction = place.up_direction
            client.camera.position = place.position
            client.camera.look_at = place.look_at

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._settled.clear()
        return []

    def follow(self, frame: Frame) -> list[Change]:
        """Return the changes that keep the cameras with the drone. Called for every frame."""
        position = frame.drone_position
        _, target = view("follow", position, np.asarray(frame.observation.goal.position, dtype=np.float64))
        changes: list[Change] = []
        clients = self.page.server.get_clients()
        if has_hit_ground(frame) != self._is_on_ground:
            self._is_on_ground = not self._is_on_ground
            for number in clients:
                if self._mode(number) == "follow":
                    self._settled.pop(number, None)
        if not self._settled:
            # The first view of pages that are opened from now on.
            start, look_at = self._views.find("follow", frame)
            initial = self.page.server.initial_camera
            changes += [(initial, "position", start), (initial, "look_at", look_at)]
        self.eyes = []
        for number, client in clients.items():
            camera, mode = client.camera, self._mode(number)
            eye = np.asarray(camera.position, dtype=np.float64)
            if time.monotonic() < self._settled.setdefault(number, time.monotonic() + _SETTLE_TIME):
                eye, look_at = self._views.find(mode if mode in VIEWS else "follow", frame)
                changes += [(camera, "position", eye), (camera, "look_at", look_at)]
                self._followers.pop(number, None)
            elif mode != "free" and not np.array_equal(target, self._targets.get(number, target + 1.0)):
                # Moving a camera also moves the point that it looks at. While the drone is at rest, the camera is left
                # alone: its position may be older than what the visitor's mouse does now.
                eye, is_turned = target + eye - camera.look_at, False
                if mode == "follow" and frame.world is not None:
                    known = self._followers.setdefault(number, _Follower(Outlook(self._views.sight)))
                    free = position + known.place(frame, eye - position)
                    is_turned = not np.allclose(free, eye, atol=1e-3)
                    eye = free if is_turned else eye
                changes += [(camera, "position", eye), *([(camera, "look_at", target)] if is_turned else [])]
            self._targets[number] = target
            self.eyes.append(eye)
        return changes

    def is_settling(self, client: viser.ClientHandle) -> bool:
        """Return True while the page still moves its camera to its first view."""
        return time.monotonic() < self._settled.get(client.client_id, np.inf)

    def _mode(self, number: int) -> str:
        return self._modes.get(number, MODES[0])

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for table in (self._modes, self._marks, self._settled, self._targets, self._followers):
            for number in set(table) - set(clients):
                table.pop(number, None)


def _mark(mode: str) -> str:
    """Return an empty element that tells the style sheet which button of the group is active."""
    return f'<i class="{MODE_CLASS}{MODES.index(mode) + 1}"></i>'


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
