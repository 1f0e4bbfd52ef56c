"""Sliders for wind and sensor faults during the flight, and arrows that move the drone while the session is paused."""

from __future__ import annotations

import threading
from typing import Any

import viser

from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import ARROWS, Hold, Page, Panel
from aero_viz.dashboard.panels.controls import SliderControl
from aero_viz.flight.conditions import LIVE
from aero_viz.flight.source import LATENCY_MAX
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_ENDS = {
    "noise.position": 0.5, "noise.velocity": 1.0, "noise.attitude": 5.0, "drone.drag": 1.0, "drone.gust_speed": 10.0,
    "lidar.range_noise": 0.5, "lidar.dropout": 1.0, "lidar.strays": 0.1, "lidar.sweep_loss": 1.0,
    "drone.latency": LATENCY_MAX,
}  # fmt: skip
"""Upper ends of the sliders, in the unit of the parameter."""
_DRAG = 0.3
"""Drag that a drone without any gets when a user asks for wind, which acts through the drag [1/s]."""

_HINT = "It acts at once; the same name in the Fly tab acts from the next flight on."


class DisturbancePanel(Panel):
    """Sliders of the parameters that may change during a flight, and the drone itself.

    Args:
        page: page of the panel.
        controls: commands of the session; every change belongs to the tick at which it is made.
        folder: folder of the controls, which is hidden unless the source is a flight.
    """

    def __init__(self, page: Page, controls: SessionControls, folder: viser.GuiFolderHandle) -> None:
        self._controls, self._folder = controls, folder
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._touched, self._dragged = Hold(), Hold()
        hint = "Show arrows that move the drone. They appear while the session is paused."
        self._drag = gui.add_checkbox("Drag the drone", False, hint=hint)
        self._sliders = [SliderControl(gui, info, float(info.default), end=_ENDS[info.path]) for info in LIVE]
        self._arrows = self.page.server.scene.add_transform_controls("/drone_arrows", **ARROWS)
        self._waiting: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._changes = Mailbox(self._change, name="aero-viz-conditions")
        self._moves = Mailbox(self._move, name="aero-viz-drone")
        for slider in self._sliders:
            slider.number.hint = f"{slider.number.hint} {_HINT}"
            slider.on_change(lambda _, slider=slider: self._take(slider))

        @self._drag.on_update
        async def _(_: viser.GuiEvent) -> None:
            self.page.refresh()

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._dragged.begin()
            if not self.session.playing:
                self._moves.put((tuple(self._arrows.position), event.phase != "end"))

    def _take(self, slider: SliderControl) -> None:
        self._touched.begin()
        with self._lock:
            self._waiting[slider.info.path] = slider.value
        self._changes.put(None)

    def _change(self, _: None) -> None:
        """Use the pending values, on the mailbox's thread."""
        with self._lock:
            values, self._waiting = self._waiting, {}
        frame = self.session.frame
        present = {} if frame is None else frame.observation.conditions or {}
        if values.get("drone.gust_speed", 0.0) > 0.0 and not values.get("drone.drag", present.get("drone.drag")):
            values["drone.drag"] = _DRAG
        if values and self._controls.alter(lambda source: source.set_conditions(values)).exception() is not None:
            self._touched.end()  # show the values that stay
        self.page.refresh()
        self.page.refresh_after()

    def _move(self, move: tuple[tuple[float, float, float], bool]) -> None:
        place, is_dragged = move
        self._controls.alter(lambda source: source.set_position(place), quiet=is_dragged).exception()
        if not is_dragged:
            self._dragged.end()
        self.page.refresh()
        self.page.refresh_after()

    def close(self) -> None:
        self._changes.close()
        self._moves.close()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        return [(self._folder, "visible", source.closed_loop and source.world is not None)]

    def update(self, frame: Frame) -> list[Change]:
        values = frame.observation.conditions
        changes: list[Change] = []
        if values is not None and not self._touched:
            changes = [change for slider in self._sliders for change in slider.show(values[slider.info.path])]
        is_offered = values is not None and self._drag.value and not self.session.playing
        changes.append((self._arrows, "visible", is_offered))
        if not self._dragged:
            place = frame.drone_position
            changes.append((self._arrows, "position", place))
        return changes
