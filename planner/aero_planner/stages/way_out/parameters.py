"""Parameters of the way out of dead ends."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live


@dataclass(frozen=True)
class Parameters(ParameterSection, section="way_out"):
    """Way out of dead ends: a tabu memory of local minima, and anchors that look around."""

    q_escape: float = live(
        240.0, "1/m", 0.0, 1e4, "Weight of the depth of a rollout's end in the neighbourhood of each remembered place.",
        label="Escape weight", basic=True,
    )  # fmt: skip
    radius: float = live(
        4.0, "m", 0.1, 20.0, "Radius of the neighbourhood of a remembered place. The goal has one of half this radius, "
        "in which the weight of all places fades out.",
        label="Radius of a place",
    )  # fmt: skip
    patience: float = live(
        0.15, "s", 0.05, 10.0, "Time without progress toward the goal after which the place is remembered.",
        label="Patience",
    )  # fmt: skip
    spread: float = live(
        3.0, "", 1.0, 5.0, "Factor on the spacing of the anchors of a drone below 3 m/s, to find a way around an "
        "obstacle; half as much again up and down.",
        label="Spread of anchors at low speed",
    )  # fmt: skip
