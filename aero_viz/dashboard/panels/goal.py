"""Moves the goal: by numbers or by dragging it in the scene."""

from __future__ import annotations

import time

import numpy as np
import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.sinks import Sink

__all__ = ["GoalPanel"]

_HOLD = 0.7
"""How long the goal is left to the hand that moved it [s]."""


class GoalPanel(Panel):
    """The goal's coordinates, and three arrows at the goal."""

    def create(self, gui: viser.GuiApi) -> None:
        self._typed = self._dragged = -_HOLD
        self._position = gui.add_vector3("Goal", (0.0, 0.0, 0.0), step=0.5, hint="x, y, z in the world [m].")
        self._drag = gui.add_checkbox("Drag the goal", False, hint="Show arrows at the goal that move it.")
        self._arrows = self.page.server.scene.add_transform_controls(
            "/goal_arrows", scale=2.0, disable_rotations=True, depth_test=False, visible=False
        )
        self._moves = Sink(self._move, name="goal")

        @self._position.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._typed = time.monotonic()
                self._moves.put((self._position.value, False))

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._dragged = time.monotonic()
            self._moves.put((tuple(self._arrows.position), event.phase != "end"))

        @self._drag.on_update
        async def _(_: viser.GuiEvent) -> None:
            self._arrows.visible = self._drag.value

    def close(self) -> None:
        self._moves.close()

    def _move(self, move: tuple[tuple[float, float, float], bool]) -> None:
        """Runs in the sink's thread. A place that is refused is news only where the hand lets go."""
        position, on_the_way = move
        refused = self.session.set_goal(position, quiet=on_the_way).exception() is not None
        if refused and not on_the_way:
            self._typed = self._dragged = -_HOLD  # back to the goal that stays
        self.page.refresh()

    def update(self, frame: Frame) -> list[Change]:
        goal, now = np.asarray(frame.observation.goal.position, dtype=np.float64), time.monotonic()
        changes: list[Change] = []
        if now - self._typed >= _HOLD:
            changes.append((self._position, "value", tuple(float(round(x, 2)) for x in goal)))
        if now - self._dragged >= _HOLD:
            changes.append((self._arrows, "position", goal))
        return changes
