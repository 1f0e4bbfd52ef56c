"""The waypoints of a mission."""

from __future__ import annotations

import numpy as np
import viser

from aero_planner.mission_progress import MissionProgress
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.base import Change, ColorKey, Layer, Lines, polylines
from aero_viz.session.frame import Frame

_BEHIND, _SHOWN = 20, 100
_CORNERS = 2000
"""Corners of the line through the waypoints: recorded paths have more."""
_AHEAD, _PASSED = palette.unmapped(palette.GOAL), palette.unmapped(palette.DRONE)
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 33)
_RING = polylines(np.stack((np.cos(_ANGLES), np.sin(_ANGLES), np.zeros_like(_ANGLES)), axis=1).astype(np.float32))
_CROSS = np.sqrt(0.5) * np.array([[[-1, -1, 0], [1, 1, 0]], [[-1, 1, 0], [1, -1, 0]]], dtype=np.float32)


def shown_waypoints(progress: MissionProgress) -> range:
    """Return the indices of the waypoints that are shown: those around the drone, of a long mission."""
    first = max(0, min(progress.index - _BEHIND, len(progress.mission) - _SHOWN))
    return range(first, min(first + _SHOWN, len(progress.mission)))


class MissionLayer(Layer):
    """Waypoints of a mission with their numbers, and a line through them; nothing for a single goal.

    A ring has the radius within which a waypoint is passed; that of the present one is bold. A cross is given up.
    """

    name, title = "mission", "Waypoints"
    keys = (
        ColorKey("waypoints ahead; crosses: given up", palette.GOAL),
        ColorKey("waypoints that were passed", palette.DRONE),
    )

    def create(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._shown: tuple[object, ...] = ()
        self._way = Lines(scene, "/mission/way", thickness=1.0)
        self._passed = Lines(scene, "/mission/passed", thickness=2.0)
        self._ahead = Lines(scene, "/mission/ahead", thickness=2.0)
        self._present = Lines(scene, "/mission/present", thickness=5.0)
        self._numbers: list[viser.LabelHandle] = []

    def update(self, frame: Frame) -> list[Change]:
        progress = frame.observation.mission
        shown = () if progress is None else (progress.mission, progress.index, progress.events)
        if len(shown) == len(self._shown) and all(new is old for new, old in zip(shown, self._shown, strict=True)):
            return []
        self._shown = shown
        return self._show(None if progress is None or progress.mission.is_single else progress)

    def _show(self, progress: MissionProgress | None) -> list[Change]:
        way = np.zeros((0, 3), dtype=np.float32)
        rings: dict[Lines, list[np.ndarray]] = {self._passed: [], self._ahead: [], self._present: []}
        shown = range(0) if progress is None else shown_waypoints(progress)
        changes: list[Change] = [(number, "visible", False) for number in self._numbers[len(shown) :]]
        if progress is not None:
            waypoints = progress.mission.waypoints
            way = np.array(progress.mission.places(waypoints[0].position)[1:], dtype=np.float32)
            way = way[:: 1 + len(way) // _CORNERS]
            given_up = {event.waypoint for event in progress.events if event.kind == "given_up"}
            for label, i in enumerate(shown):
                place, radius = np.array(waypoints[i].position, dtype=np.float32), waypoints[i].radius
                lines = self._present if i == progress.index else self._ahead
                if i < progress.index and i not in given_up:
                    lines = self._passed
                rings[lines].append(place + radius * (_CROSS if i in given_up else _RING))
                changes += self._number(label, f"{i + 1}", place)
        for lines, marks in rings.items():
            segments = np.concatenate(marks) if marks else np.zeros((0, 2, 3))
            changes += lines.show(segments, _PASSED if lines is self._passed else _AHEAD)
        return [*changes, *self._way.show(polylines(way), _AHEAD)]

    def _number(self, label: int, text: str, place: np.ndarray) -> list[Change]:
        while len(self._numbers) <= label:
            name = f"/mission/number_{len(self._numbers)}"
            self._numbers.append(self._scene.add_label(name, "", anchor="bottom-center", visible=False))
        handle = self._numbers[label]
        return [(handle, "text", text), (handle, "position", place), (handle, "visible", True)]

    def legend(self, frame: Frame) -> list[ColorKey]:
        progress = frame.observation.mission
        if progress is None or progress.mission.is_single:
            return []
        return list(self.keys) if progress.passed else list(self.keys[:1])
