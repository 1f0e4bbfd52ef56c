"""Parameters of the estimate of disturbance and drag."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live


@dataclass(frozen=True)
class Parameters(ParameterSection, section="disturbance"):
    """Disturbance and drag: estimated from the acceleration that the model does not explain."""

    disturbance_time: float = live(
        0.2, "s", 0.0, 10.0, "Time over which the acceleration that the model does not explain, such as that of gusts, "
        "is averaged. It is fed forward unless it slows the drone down. 0: no disturbance is assumed.",
        label="Averaging of disturbances",
    )  # fmt: skip
    drag_time: float = live(
        2.0, "s", 0.0, 100.0, "Time over which the drag is estimated, from the part of that acceleration that is "
        "proportional to the velocity and against it. 0: no drag is assumed.",
        label="Averaging of drag",
    )  # fmt: skip
