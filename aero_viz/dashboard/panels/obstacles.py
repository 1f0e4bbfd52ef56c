"""Controls that add, throw, move, resize and remove obstacles while a flight goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import viser

from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.layers.scenery import ObstacleLayer
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import ARROWS, Hold, Page, Panel
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.errors import UserError
from aero_viz.scenes.obstacles import (
    Obstacle,
    ObstacleId,
    ObstacleKey,
    find_obstacle,
    identify,
    new_obstacle,
    obstacle_at,
    pick_obstacle,
    with_obstacle,
)
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_PAUSE = 0.4
"""Time for which a typed number must stay unchanged before it is used [s]: a 12 is first a 1."""
_SIZES = {"cylinder": (0.6, 0.6, 4.0), "box": (1.0, 1.0, 1.0), "sphere": (1.0, 1.0, 1.0)}
_ADDED_AT = (6.0, 3.0)
"""Offset of an added obstacle from the drone, towards the goal and to the left [m]."""
_THROWN_FARTHER_THAN = 3.0
"""Smallest distance from the drone to a thrown obstacle [m]."""
_ABSENT = "Open a scene or a world to change its obstacles: a recording has none."
_NOTHING = "Click an obstacle in the scene to select it."


class ObstaclePanel(Panel):
    """Buttons that add obstacles, and the size, the arrows and the removal of the one that is selected.

    Args:
        page: page of the panel.
        controls: commands of the session, which holds the world; every edit belongs to the tick at which it is made.
        tabs: the tabs that are open.
    """

    def __init__(self, page: Page, controls: SessionControls, tabs: OpenTabs) -> None:
        self._controls = controls
        self._tabs = tabs
        self._selected: ObstacleId | None = None
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._touched, self._dragged = Hold(), Hold()
        self._drag_step = object()
        """Stands for the drag in progress, or else for the next one."""
        self._grabbed_at: tuple[float, ...] | None = None
        """Position of the arrows at which they were grabbed, until they move [m]."""
        self._absence = gui.add_html(markup.note(_ABSENT), visible=False)
        with gui.add_folder(None) as self._folder:
            self._create_controls(gui)
        self._arrows = self.page.server.scene.add_transform_controls("/obstacle_arrows", disable_sliders=True, **ARROWS)
        self._typed: dict[tuple[ObstacleId | None, str], Callable[[Obstacle], Obstacle]] = {}
        """Changes by numbers that were typed and wait, by obstacle and label of the field."""
        self._lock = threading.Lock()
        self._numbers = Mailbox(self._use_typed, name="aero-viz-obstacle-numbers")
        self._drags = Mailbox(self._drag, name="aero-viz-obstacle-drags")
        self._connect()

    def _create_controls(self, gui: viser.GuiApi) -> None:
        hint = "Put a sphere where the drone is going to be at the end of its plan."
        self._throw = gui.add_button("Throw an obstacle", icon=viser.Icon.METEOR, hint=hint)
        self._kinds = gui.add_button_group("Add", tuple(_SIZES), hint="Add one ahead of the drone, on its left.")
        hint = "Click an obstacle in the scene to select it; then move it by its arrows, resize or remove it."
        self._switch = gui.add_checkbox("Edit obstacles", False, hint=hint)
        self._name = gui.add_html(markup.note(_NOTHING), visible=False)
        self._center = gui.add_vector3("Centre [m]", (0.0, 0.0, 0.0), step=0.5, visible=False, hint="x, y, z [m].")
        hint = "Width, depth and height along its own axes [m]. Diameters of a round obstacle change together."
        self._size = gui.add_vector3("Size [m]", (1.0, 1.0, 1.0), step=0.1, visible=False, hint=hint)
        self._yaw = gui.add_number("Heading [deg]", 0.0, step=5.0, visible=False, hint="Rotation of the box about z.")
        self._center.precision = self._size.precision = self._yaw.precision = 3
        self._remove = gui.add_button("Remove", icon=viser.Icon.TRASH, color="gray", visible=False)
        hint = "Undo or redo one change of the obstacles or the parameters. Keys: Ctrl+Z, Ctrl+Shift+Z."
        self._history = gui.add_button_group("History", ("undo", "redo"), hint=hint)
        hint = "Download the world as it is now, with its goal, as JSON that `aero-viz fly` and Open path read."
        self._save = gui.add_button("Save world", icon=viser.Icon.DOWNLOAD, color="gray", hint=hint)

    def _connect(self) -> None:
        @self._throw.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.throw()

        @self._kinds.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._add(self._kinds.value, _ahead_on_left)

        @self._remove.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.remove()

        @self._history.on_click
        async def _(event: viser.GuiEvent) -> None:
            action = self._controls.undo if self._history.value == "undo" else self._controls.redo
            self.page.attempt(action, event.client)

        @self._save.on_click
        async def _(event: viser.GuiEvent) -> None:
            frame = self.session.frame
            if event.client is not None and frame is not None and frame.moving_world is not None:
                mission = frame.observation.mission
                world = frame.moving_world.with_goal(frame.observation.goal.position)
                world = world if mission is None or mission.mission.is_single else world.with_mission(mission.mission)
                event.client.send_file_download(f"{world.name}.json", world.to_json().encode(), save_immediately=True)

        self._on_input(self._center, Obstacle.moved)
        self._on_input(self._size, Obstacle.resized)
        self._on_input(self._yaw, lambda obstacle, degrees: obstacle.turned(np.radians(degrees)))

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "start":
                self._grabbed_at = tuple(self._arrows.position)
            if tuple(self._arrows.position) == self._grabbed_at:
                return  # a click
            self._grabbed_at = None
            self._dragged.begin()
            self._drags.put((self._selected, tuple(self._arrows.position), event.phase != "end"))

        @self._switch.on_update
        async def _(_: viser.GuiEvent) -> None:
            scene = self.page.server.scene
            scene.remove_click_callback(self._click)
            if self._switch.value:
                scene.on_click()(self._click)
                self.page.refresh()
            else:
                self._select(None)

    def _on_input(self, control: Any, change: Callable[[Obstacle, Any], Obstacle]) -> None:
        @control.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._touched.begin()
                value = control.value
                with self._lock:
                    self._typed[self._selected, control.label] = lambda obstacle: change(obstacle, value)
                self._numbers.put(None)

    def _click(self, event: viser.SceneClickEvent) -> None:
        # No node is clickable: viser's outline around one under the mouse fails in a scene with fog, and a faint
        # obstacle is not a separate node. The world finds the obstacle on the ray instead.
        frame = self.session.frame
        if frame is not None and frame.world is not None and self._tabs.is_open("World", event.client_id):
            layer = self.page.layers.get("obstacles")
            faint = layer.faint_obstacles if isinstance(layer, ObstacleLayer) else ()
            key = pick_obstacle(frame.world, event.ray_origin, event.ray_direction, ignored=faint)
            self._select(None if key is None else identify(frame.world, key))

    def _select(self, identity: ObstacleId | None) -> None:
        self._selected = identity
        self._touched.end()
        self._dragged.end()
        if isinstance(layer := self.page.layers.get("obstacles"), ObstacleLayer):
            layer.selected = identity
        if identity is not None:
            self._switch.value = True
        self.page.refresh()

    def throw(self) -> None:
        """Put a sphere where the drone is going to be, and select it."""
        self._add("sphere", _end_of_plan)

    def remove(self) -> None:
        """Remove the selected obstacle."""
        if self._selected is not None:
            self._alter(self._selected, lambda _: None)
            self._select(None)

    def _add(self, kind: str, place: Callable[[Frame], np.ndarray]) -> None:
        """Add an obstacle at a place that is computed when it is added, and select it."""

        def change(source: Any) -> None:
            frame = self.session.frame
            assert frame is not None
            obstacle = new_obstacle(kind, place(frame), _SIZES[kind])
            source.set_world(with_obstacle(_world(source), obstacle))
            world = _world(source)
            self._select(identify(world, ObstacleKey(obstacle.kind, len(getattr(world, obstacle.kind)) - 1)))

        if not self._folder.visible:
            raise UserError(_ABSENT)
        self._controls.alter(change)

    def _use_typed(self, _: None) -> None:
        """Use typed numbers, on the mailbox's thread, once they stay unchanged or another obstacle is selected."""
        while (rest := self._touched.began + _PAUSE - time.monotonic()) > 0.0:
            time.sleep(rest)
        typed_at = self._touched.began
        with self._lock:
            typed, self._typed = self._typed, {}
        for (identity, _label), change in typed.items():
            self._alter(identity, change).exception()
        if self._touched.began == typed_at:
            self._touched.end()  # show what is in the world now
        self.page.refresh()

    def _drag(self, move: tuple[ObstacleId | None, tuple[float, ...], bool]) -> None:
        """Move an obstacle, on the mailbox's thread. While it is dragged, a refusal is not reported."""
        identity, place, is_dragged = move
        step = self._drag_step
        error = self._alter(identity, lambda obstacle: obstacle.moved(place), quiet=is_dragged, step=step).exception()
        if not is_dragged:
            self._drag_step = object()
            if error is not None:
                self._dragged.end()
        self.page.refresh()
        self.page.refresh_after()

    def _alter(
        self,
        identity: ObstacleId | None,
        change: Callable[[Obstacle], Obstacle | None],
        *,
        quiet: bool = False,
        step: object = None,
    ) -> Future[Any]:
        """Change an obstacle, or remove it if `change` returns None."""

        def alter(source: Any) -> None:
            world = _world(source)
            key = None if identity is None else find_obstacle(world, identity)
            obstacle = None if key is None else obstacle_at(world.at(source.observe().time), key)
            if obstacle is None:
                raise UserError("Select an obstacle first: the one that was selected is not in this world.")
            changed = change(obstacle)
            if changed is None or not np.allclose(changed.values, obstacle.values, rtol=0.0, atol=1e-9):
                source.set_world(with_obstacle(world, changed, key))

        return self._controls.alter(alter, quiet=quiet, step=step)

    def close(self) -> None:
        self._numbers.close()
        self._drags.close()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        is_offered = source.closed_loop and source.world is not None
        return [
            (self._folder, "visible", is_offered),
            (self._absence, "visible", not is_offered),
            (self._switch, "value", False),
        ]

    def update(self, frame: Frame) -> list[Change]:
        """Show the selected obstacle. At a tick at which it does not exist, none is selected."""
        identity, world = self._selected, frame.world
        key = None if identity is None or world is None else find_obstacle(world, identity)
        obstacle = None if key is None or world is None else obstacle_at(world, key)
        controls = (self._center, self._size, self._remove, self._arrows)
        changes: list[Change] = [(control, "visible", obstacle is not None) for control in controls]
        changes.append((self._name, "visible", self._switch.value))
        if key is None or obstacle is None:
            return [*changes, (self._yaw, "visible", False), (self._name, "content", markup.note(_NOTHING))]
        changes += [
            (self._yaw, "visible", obstacle.kind == "boxes"),
            (self._name, "content", markup.note(f"Selected: {key.name}")),
        ]
        if not self._touched:
            changes += [
                (self._center, "value", _rounded(obstacle.center)),
                (self._size, "value", _rounded(obstacle.size)),
                (self._yaw, "value", round(float(np.degrees(obstacle.yaw)), 3)),
            ]
        if not self._dragged:
            changes.append((self._arrows, "position", obstacle.center))
        return changes


def _world(source: Any) -> Any:
    return source.observe().world


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(round(value, 3)) for value in values)


def _drone_and_heading(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of the drone [m] and the horizontal unit vector to the goal, each of shape [3]."""
    drone = frame.drone_position
    across = np.asarray(frame.observation.goal.position, dtype=np.float64) - drone
    across[2] = 0.0
    return drone, across / max(float(np.linalg.norm(across)), 1e-9)


def _end_of_plan(frame: Frame) -> np.ndarray:
    """Return the end of the plan, or a place beyond it so that the drone is not in the obstacle [m], shape [3]."""
    drone, heading = _drone_and_heading(frame)
    end = np.asarray(frame.plan.positions[int(frame.plan.best), -1], dtype=np.float64)
    return end if np.linalg.norm(end - drone) >= _THROWN_FARTHER_THAN else drone + _THROWN_FARTHER_THAN * heading


def _ahead_on_left(frame: Frame) -> np.ndarray:
    """Return the place `_ADDED_AT` from the drone [m], shape [3]."""
    drone, heading = _drone_and_heading(frame)
    return drone + _ADDED_AT[0] * heading + _ADDED_AT[1] * np.array((-heading[1], heading[0], 0.0))
