"""Controls that move one place of the world: numbers, and arrows in the scene."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from aero_planner.mailbox import Mailbox
from aero_planner.missions import Position
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import ARROWS, Hold, Page


class PlaceControls:
    """Coordinates of a place, and three arrows at it. Create it in the open container.

    Args:
        page: page of the controls.
        name: name of the place, such as "goal".
        label: label of the coordinates.
        hint: explanation of the coordinates.
        move: moves the place [m] and returns what becomes of it; with True as long as it is dragged.
    """

    def __init__(
        self, page: Page, *, name: str, label: str, hint: str, move: Callable[[Position, bool], Future[Any]]
    ) -> None:
        self._page, self._move = page, move
        self._typed, self._dragged = Hold(), Hold()
        gui = page.server.gui
        self._position = gui.add_vector3(label, (0.0, 0.0, 0.0), step=0.5, hint=hint)
        self._position.precision = 3
        self._drag = gui.add_checkbox(f"Drag the {name}", False, hint=f"Show arrows at the {name} that move it.")
        self._arrows = page.server.scene.add_transform_controls(f"/{name}_arrows", **ARROWS)
        self._moves = Mailbox(self._use, name=f"aero-viz-{name}")

        @self._position.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._typed.begin()
                self._moves.put((self._position.value, False))

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._dragged.begin()
            x, y, z = self._arrows.position
            self._moves.put(((x, y, z), event.phase != "end"))

        @self._drag.on_update
        async def _(_: viser.GuiEvent) -> None:
            page.refresh()

    def close(self) -> None:
        """Stop the thread."""
        self._moves.close()

    @property
    def is_held(self) -> bool:
        """True while somebody moves the place."""
        return bool(self._typed or self._dragged)

    def release(self) -> None:
        """Show another place at once, although somebody has just moved the one before."""
        self._typed.end()
        self._dragged.end()

    def _use(self, move: tuple[Position, bool]) -> None:
        """Move the place, on the mailbox's thread."""
        position, is_dragged = move
        is_refused = self._move(position, is_dragged).exception() is not None
        if is_refused and not is_dragged:
            self.release()  # show the place that stays
        self._page.refresh()
        self._page.refresh_after()

    def show(self, place: ArrayLike | None) -> list[Change]:
        """Return the changes that show a place [m], shape [3]; None has no arrows."""
        if place is None:
            return [(self._arrows, "visible", False)]
        position = np.asarray(place, dtype=np.float64)
        changes: list[Change] = [(self._arrows, "visible", self._drag.value)]
        if not self._typed:
            changes.append((self._position, "value", tuple(float(round(x, 3)) for x in position)))
        if not self._dragged:
            changes.append((self._arrows, "position", position))
        return changes
