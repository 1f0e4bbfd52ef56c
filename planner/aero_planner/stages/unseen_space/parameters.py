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
    view_width: float = live(
        360.0, "deg", 0.0, 360.0, "Width of the view in azimuth. What lies beside it is unknown.",
        label="Width of the view",
    )  # fmt: skip
    view_middle: float = live(
        0.0, "deg", -180.0, 180.0, "Azimuth of the middle of the view, body frame, positive to the left.",
        label="Middle of the view",
    )  # fmt: skip
    second_min: float = live(
        -90.0, "deg", -90.0, 90.0, "Lowest elevation that a second sensor sees.", label="Lower edge of a second view"
    )
    second_max: float = live(
        90.0, "deg", -90.0, 90.0, "Highest elevation that a second sensor sees.", label="Upper edge of a second view"
    )
    second_width: float = live(
        0.0, "deg", 0.0, 360.0, "Width in azimuth of what a second sensor sees; 0 without one.",
        label="Width of a second view",
    )  # fmt: skip
    second_middle: float = live(
        180.0, "deg", -180.0, 180.0, "Azimuth of the middle of a second view, body frame, positive to the left.",
        label="Middle of a second view",
    )  # fmt: skip
    unknown_range: float = live(
        2.0, "m", 0.0, 20.0, "Distance from which space beside the view, where no surface was measured, counts as a "
        "surface. Nearer, the drone has seen it on its way.",
        label="Begin of unknown space",
    )  # fmt: skip
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
