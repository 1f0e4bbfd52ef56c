"""Controls that change a mission: waypoints by clicks, arrows and numbers, their order, and files."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import viser

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import RADIUS, Mission, Position
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Hold, Page, Panel
from aero_viz.dashboard.panels.mission_edits import Edit, above_ground, added, moved, removed, replaced, swapped
from aero_viz.dashboard.panels.mission_text import describe, format_mission, parse_mission
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.dashboard.panels.place import PlaceControls
from aero_viz.errors import UserError
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_ABSENT = "Open a scene or a world to fly a mission: the motion in a recording is fixed."


class MissionPanel(Panel):
    """Length and state of the mission, and controls of the waypoints ahead of the drone.

    Args:
        page: page of the panel.
        controls: commands of the session. Every change is one mission that the source checks and flies on with.
        tabs: the tabs that are open.
    """

    def __init__(self, page: Page, controls: SessionControls, tabs: OpenTabs) -> None:
        self._controls, self._tabs = controls, tabs
        self._selected = 0
        """Index of the waypoint that was selected last; the drone may have passed it meanwhile."""
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._touched = Hold()
        self._shown: tuple[object, ...] = ()
        self._text = gui.add_html("")
        with gui.add_folder(None) as self._folder:
            hint = "A click on the ground puts a waypoint above it, as high as the goal and before it in the order."
            self._add = gui.add_checkbox("Add waypoints", False, hint=hint)
            with gui.add_folder(None) as self._ahead:
                self._create_waypoint(gui)
            hint = "Save the mission as YAML that `aero-viz fly` and `demo` read with --mission."
            self._save = gui.add_button("Download mission", icon=viser.Icon.DOWNLOAD, color="gray", hint=hint)
            self._load = gui.add_upload_button(
                "Upload mission", icon=viser.Icon.UPLOAD, color="gray", mime_type=".yaml,.yml",
                hint="Fly the mission of a YAML file from here.",
            )  # fmt: skip
        self._connect()

    def _create_waypoint(self, gui: viser.GuiApi) -> None:
        self._number = gui.add_number("Waypoint", 1, min=1, max=1, step=1, hint="Number of the waypoint to change.")
        self._place = PlaceControls(
            self.page,
            name="waypoint",
            label="Place [m]",
            hint="x, y, z in the world frame [m].",
            move=self._move,
        )
        self._radius = gui.add_number("Radius [m]", RADIUS, min=0.0, step=0.1, hint="How near the drone must come.")
        self._speed = gui.add_number(
            "Leg speed [m/s]", 0.0, min=0.0, step=0.5, hint="Speed limit on the way there; 0 is that of the planner."
        )
        self._radius.precision = self._speed.precision = 3
        self._stop = gui.add_checkbox("Stop there", False, hint="Stop at the waypoint; otherwise, fly on.")
        self._order = gui.add_button_group(
            "Order", ("move up", "move down", "remove"), hint="Fly to it earlier, later, or not at all."
        )

    def _connect(self) -> None:
        @self._add.on_update
        async def _(_: viser.GuiEvent) -> None:
            scene = self.page.server.scene
            scene.remove_click_callback(self._click)
            if self._add.value:
                scene.on_click()(self._click)

        @self._number.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._select(int(self._number.value) - 1)
                self.page.refresh()

        @self._order.on_click
        async def _(_: viser.GuiEvent) -> None:
            step = {"move up": -1, "move down": 1}.get(self._order.value)
            # The selected one is known when the click before has been obeyed.
            self._change(lambda number: removed(number) if step is None else swapped(number, number + step))

        @self._save.on_click
        async def _(event: viser.GuiEvent) -> None:
            frame = self.session.frame
            if event.client is not None and frame is not None and frame.observation.mission is not None:
                content = format_mission(frame.observation.mission.mission)
                event.client.send_file_download("mission.yaml", content.encode(), save_immediately=True)

        @self._load.on_upload
        async def _(event: viser.GuiEvent) -> None:
            file = self._load.value

            def fly() -> None:
                mission = parse_mission(file)
                self._set(lambda _: (mission, 0), quiet=True).result()

            # A large file takes a while, and the event loop serves all pages.
            is_used = await asyncio.to_thread(self.page.attempt, fly, event.client)
            if not is_used and event.client is not None:
                self.page.server.hide_upload(event.client)

        self._on_input(self._radius, lambda radius: {"radius": float(radius)})
        self._on_input(self._speed, lambda speed: {"speed": float(speed) or None})
        self._on_input(self._stop, lambda stop: {"stop": stop})

    def _on_input(self, control: Any, values: Callable[[Any], dict[str, Any]]) -> None:
        @control.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._touched.begin()
                number, changes = int(self._number.value) - 1, values(control.value)
                self._change(lambda _: replaced(number, lambda waypoint: dataclasses.replace(waypoint, **changes)))

    def _click(self, event: viser.SceneClickEvent) -> None:
        if self._tabs.is_open("Fly", event.client_id):
            self.page.attempt(lambda: self._add_at(event.ray_origin, event.ray_direction), event.client)

    def _add_at(self, origin: Position, direction: Position) -> None:
        frame = self.session.frame
        if frame is None or frame.observation.mission is None:
            raise UserError(_ABSENT)
        edit = added(above_ground(frame.observation, origin, direction))
        self._change(lambda _: edit)

    def _move(self, place: Position, is_dragged: bool) -> Future[Any]:
        """Move the waypoint that is shown. While it is dragged, a refusal is not reported."""
        number = int(self._number.value) - 1
        return self._change(lambda _: moved(number, place), quiet=is_dragged)

    def _change(self, edit: Callable[[int], Edit], *, quiet: bool = False) -> Future[Any]:
        """Change the waypoints ahead of the drone, given the selected one when the change is made."""

        def change(progress: MissionProgress) -> tuple[Mission, int]:
            waypoints = list(progress.mission.waypoints)
            selected = edit(self._selection(progress))(waypoints, progress.index)
            return Mission(tuple(waypoints)), selected

        return self._set(change, resume=True, quiet=quiet)

    def _set(
        self, change: Callable[[MissionProgress], tuple[Mission, int]], *, resume: bool = False, quiet: bool = False
    ) -> Future[Any]:
        def alter(source: Any) -> None:
            progress = source.observe().mission
            if not self._folder.visible or progress is None:
                raise UserError(_ABSENT)
            mission, selected = change(progress)
            source.set_mission(mission, resume=resume)
            self._select(selected)

        def show(_: Future[Any]) -> None:
            self._touched.end()
            self.page.refresh()

        future = self._controls.alter(alter, quiet=quiet)
        future.add_done_callback(show)
        return future

    def _selection(self, progress: MissionProgress) -> int:
        return min(max(self._selected, progress.index), len(progress.mission) - 1)

    def _select(self, index: int) -> None:
        if index != self._selected:
            self._selected = index
            self._touched.end()
            self._place.release()

    def close(self) -> None:
        self._place.close()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._select(0)
        is_offered = source.closed_loop and source.world is not None
        return [(self._folder, "visible", is_offered), (self._add, "value", False)]

    def update(self, frame: Frame) -> list[Change]:
        progress = frame.observation.mission
        if progress is None:
            return [(self._text, "content", markup.note(_ABSENT)), *self._place.show(None)]
        config = frame.base_config or frame.config
        shown = (progress.mission, progress.index, progress.events, config, frame.source)
        changes: list[Change] = []
        if len(self._shown) != len(shown) or any(new is not old for new, old in zip(shown, self._shown, strict=True)):
            self._shown = shown
            start = progress.mission.waypoints[0].at(0.0) if frame.source.world is None else frame.source.world.start
            changes.append((self._text, "content", describe(progress, start, config.vehicle.speed_limit)))
        changes.append((self._ahead, "visible", not progress.is_over))
        if progress.is_over or not self._folder.visible:
            return [*changes, *self._place.show(None)]
        number = self._selection(progress)
        if number != self._number.value - 1:
            if self._place.is_held:
                return changes  # the one that is dragged has just been passed
            self._place.release()
        waypoint = progress.mission.waypoints[number]
        changes += [
            (self._number, "min", progress.index + 1),
            (self._number, "max", len(progress.mission)),
            (self._number, "value", number + 1),
            *self._place.show(waypoint.position),
        ]
        if not self._touched:
            changes += [
                (self._radius, "value", waypoint.radius),
                (self._speed, "value", waypoint.speed or 0.0),
                (self._stop, "value", waypoint.stop),
            ]
        return changes
