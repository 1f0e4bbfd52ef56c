"""Controls of the conditions of a flight: obstacles, LiDAR, noise and wind."""

from __future__ import annotations

import inspect

import viser

from aero_planner import PlannerConfig
from aero_viz.dashboard.panels.controls import Control, add_number
from aero_viz.flight import VehicleModel
from aero_viz.flight.conditions import OFFERED, with_conditions
from aero_viz.scenes import SCENES
from aero_viz.scenes.generators import COUNT_MAX
from aero_viz.sensors.models import LIDARS
from aero_viz.session.source import Conditions

_HINT = "Open applies it: the flight that is shown stays as it is."


class ConditionControls:
    """Controls for the conditions of the next flight that is opened.

    Args:
        gui: where to add them.
        first: initial conditions.
    """

    def __init__(self, gui: viser.GuiApi, first: Conditions) -> None:
        self._spec = ""
        self._count = gui.add_number("Obstacles", 0, step=1, hint=f"Number of obstacles. {_HINT}")
        names = tuple(dict.fromkeys([first.lidar or "mid360", *LIDARS]))
        self._lidar = gui.add_dropdown("LiDAR", names, initial_value=names[0], hint=f"Model of the LiDAR. {_HINT}")
        with gui.add_folder("Noise and wind", expand_by_default=False):
            self._values: list[Control] = [
                add_number(gui, info, first.values.get(info.path, info.default)) for info in OFFERED
            ]

    def offer(self, spec: str, *, count: int | None = None) -> None:
        """Show the number of obstacles of a newly chosen scene: `count`, or its default."""
        if spec == self._spec:
            return
        self._spec = spec
        own = _own_count(spec)
        self._count.disabled = own is None
        self._count.value = own or 0 if count is None else count

    def read(self, spec: str) -> Conditions:
        """Return the conditions on the page, for the source `spec`.

        Raises:
            ValueError: a value is out of its bounds or contradicts another one; says how to correct it.
        """
        own, count = _own_count(spec), int(self._count.value)
        if not 0 <= count <= COUNT_MAX:  # no bounds of the field: the browser would silently replace the number
            raise ValueError(f"The number of obstacles is {count}; it must be a whole number in [0, {COUNT_MAX}].")
        conditions = Conditions(
            count=None if own is None or spec != self._spec or count == own else count,
            lidar=self._lidar.value,
            values={control.info.path: control.info.check(control.value) for control in self._values},
        )
        default = {"lidar": None, "vehicle": VehicleModel.from_config(PlannerConfig()), "noise": None}
        with_conditions({**default, "lidar": LIDARS.get(self._lidar.value)}, conditions)
        return conditions


def _own_count(spec: str) -> int | None:
    """Return the default number of obstacles of a scene; None if it cannot be chosen."""
    if spec not in SCENES or not SCENES[spec].counted:
        return None
    return int(inspect.signature(SCENES[spec].generate).parameters["count"].default)
