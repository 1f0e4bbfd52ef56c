"""Parameters of the anchors and of the guides to them."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, structural


@dataclass(frozen=True)
class AnchorConfig(ParameterSection, section="anchors"):
    """Anchors: the end points of the guides."""

    columns: int = structural(5, 1, 15, "Anchor directions side by side.", label="Anchor columns", symbol="M_h")
    rows: int = structural(3, 1, 9, "Anchor directions one above the other.", label="Anchor rows", symbol="M_v")
    spacing: float = live(
        18.0, "deg", 1.0, 45.0, "Angle between neighbouring anchor directions.", label="Anchor spacing", basic=True
    )
    lookahead: float = live(
        5.0, "m", 0.2, 30.0, "Distance of the anchors from the drone; at most the distance of the goal, and at most "
        "0.6 times the way that the speed limit covers within the horizon.",
        label="Look-ahead distance", symbol="l", basic=True,
    )  # fmt: skip
    lookahead_time: float = live(
        0.65, "s", 0.0, 5.0, "A fast drone looks farther ahead: the look-ahead distance is at least this times the "
        "speed limit; 0 as in the paper.",
        label="Look-ahead per speed limit",
    )  # fmt: skip
