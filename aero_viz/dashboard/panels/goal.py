"""Controls that move the goal: numbers, and arrows in the scene."""

from __future__ import annotations

import numpy as np
import viser

from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import ARROWS, Hold, Page, Panel
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame


class GoalPanel(Panel):
    """Coordinates of the goal, and three arrows at the goal."""

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._typed, self._dragged = Hold(), Hold()
        self._position = gui.add_vector3("Goal [m]", (0.0, 0.0, 0.0), step=0.5, hint="x, y, z in the world frame [m].")
        self._position.precision = 3
        self._drag = gui.add_checkbox("Drag the goal", False, hint="Show arrows at the goal that move it.")
        self._arrows = self.page.server.scene.add_transform_controls("/goal_arrows", **ARROWS)
        self._moves = Mailbox(self._set_goal, name="aero-viz-goal")

        @self._position.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._typed.begin()
                self._moves.put((self._position.value, False))

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._dragged.begin()
            self._moves.put((tuple(self._arrows.position), event.phase != "end"))

        @self._drag.on_update
        async def _(_: viser.GuiEvent) -> None:
            self._arrows.visible = self._drag.value

    def close(self) -> None:
        self._moves.close()

    def _set_goal(self, move: tuple[tuple[float, float, float], bool]) -> None:
        """Move the goal, on the mailbox's thread. While it is dragged, a refused position is not reported."""
        position, is_dragged = move
        is_refused = self._controls.set_goal(position, quiet=is_dragged).exception() is not None
        if is_refused and not is_dragged:
            self._typed.end()  # show the goal that stays
            self._dragged.end()
        self.page.refresh()
        self.page.refresh_after()

    def update(self, frame: Frame) -> list[Change]:
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        changes: list[Change] = []
        if not self._typed:
            changes.append((self._position, "value", tuple(float(round(x, 3)) for x in goal)))
        if not self._dragged:
            changes.append((self._arrows, "position", goal))
        return changes
