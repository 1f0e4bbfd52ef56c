"""Controls that move the goal."""

from __future__ import annotations

import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.place import PlaceControls
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame


class GoalPanel(Panel):
    """Coordinates of the goal, and three arrows at the goal."""

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        hint = "x, y, z in the world frame [m]. A goal that is set here takes the place of a mission."
        # While it is dragged, a refused position is not reported.
        self._place = PlaceControls(
            self.page, name="goal", label="Goal [m]", hint=hint,
            move=lambda position, is_dragged: self._controls.set_goal(position, quiet=is_dragged),
        )  # fmt: skip

    def close(self) -> None:
        self._place.close()

    def update(self, frame: Frame) -> list[Change]:
        return self._place.show(frame.observation.goal.position)
