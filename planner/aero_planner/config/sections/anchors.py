"""Parameters of the anchors and of the guides to them."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.config.parameter import ParameterSection, live, structural, switch


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
        0.5, "s", 0.0, 5.0, "A fast drone looks farther ahead: the look-ahead distance is at least this times the "
        "speed limit; 0 as in the paper.",
        label="Look-ahead per speed limit",
    )  # fmt: skip
    lookahead_rest: float = live(
        3.5, "m", 0.1, 30.0,
        "Look-ahead distance at rest. It grows by 0.6 T v with the speed v, up to the look-ahead distance: from rest, "
        "a guide of full length asks for an acceleration that saturates the thrust. A value of at least the look-ahead "
        "distance disables this, as in the paper.",
        label="Look-ahead distance at rest",
    )  # fmt: skip
    slow_spread: float = live(
        3.0, "", 1.0, 5.0, "Factor on the spacing at speeds below slow_speed, to find a way around an obstacle; 1 as "
        "in the paper.",
        label="Spread factor at low speed",
    )  # fmt: skip
    slow_speed: float = live(
        3.0, "m/s", 0.0, 20.0, "Speed below which slow_spread applies.", label="Low-speed threshold"
    )
    slow_rise: float = live(
        1.5, "", 1.0, 5.0, "The same factor on the spacing of the rows, upward and downward.",
        label="Rise factor at low speed",
    )  # fmt: skip
    slow_cycle: int = live(
        2, "", 1, 10, "Number of spreads at low speed: successive plans go from a part of slow_spread to all of it.",
        label="Spreads at low speed",
    )  # fmt: skip
    refine: bool = switch(True, "Move each anchor to the safe direction of its coarse cell.", label="Refine anchors")
    arrival_speed: float = live(
        0.0, "m/s", 0.0, 20.0, "Speed at the end of each guide, in the direction of its anchor.",
        label="Guide end speed", symbol="v_1",
    )  # fmt: skip
