"""Parameters of the unseen space."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live


@dataclass(frozen=True)
class Parameters(ParameterSection, section="unseen_space"):
    """Unseen space: surfaces continue beyond the edges of the field of view."""

    view_min: float = live(
        -7.0, "deg", -90.0, 90.0, "Lowest elevation that the sensor sees, body frame. What lies below is unknown.",
        label="Lower edge of the view",
    )  # fmt: skip
    view_max: float = live(
        52.0, "deg", -90.0, 90.0, "Highest elevation that the sensor sees, body frame.", label="Upper edge of the view"
    )
    continuation: float = live(
        20.0, "m", 0.0, 20.0, "Length by which a surface at the lower or upper edge of the field of view is continued "
        "down or up, into empty cells that the sensor does not see. 0: unseen space is free.",
        label="Continuation of surfaces",
    )  # fmt: skip
    view_age: float = live(
        0.1, "s", 0.0, 1.0, "Time since the sensor has seen all of its field of view. The drone moves meanwhile, so "
        "that surfaces near the edges of the field of view are continued as well.",
        label="Age of the view",
    )  # fmt: skip
