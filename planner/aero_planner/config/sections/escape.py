"""Parameters of the memory of places without progress."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.config.parameter import ParameterSection, live


@dataclass(frozen=True)
class EscapeConfig(ParameterSection, section="escape"):
    """Memory of places without progress, which leads out of dead ends."""

    q_escape: float = live(
        240.0, "1/m", 0.0, 1e4, "Weight of the depth of a rollout's end in the neighbourhood of each remembered place; "
        "0 as in the paper.",
        label="Escape weight", basic=True,
    )  # fmt: skip
    radius: float = live(
        4.0, "m", 0.1, 20.0, "Radius of the neighbourhood of a remembered place. The goal has one of half this radius, "
        "in which the weight of all places fades out.",
    )  # fmt: skip
    ahead: float = live(
        2.0, "m", 0.01, 1e3, "Distance by which a rollout must end nearer to the goal than the drone has been, so that "
        "the remembered places cost nothing there: it leads to a way out. Ends that are nearer by less cost a part of "
        "it. 1000 m: the places cost the same everywhere.",
        label="Distance ahead without escape cost",
    )  # fmt: skip
    previous_discount: float = live(
        0.2, "", 0.0, 1.0, "Share of the escape cost that the previous plan is spared, so that a drone with two equal "
        "ways out keeps to one.",
        label="Discount of the previous plan",
    )  # fmt: skip
    rise: float = live(
        4.0, "", 1.0, 5.0, "Factor on the spacing of the rows of anchors, instead of anchors.slow_rise, for a slow "
        "drone near a remembered place: the way out may lead upward.",
        label="Rise factor near a place",
    )  # fmt: skip
    guide_depth: float = live(
        20.0, "m", 0.0, 400.0, "Sum of the depths in the neighbourhoods of remembered places above which a slow drone "
        "is stuck: its guides end in front of the surfaces that are seen, since a guide through a wall does not lead "
        "out. 400 m switches this off.",
        label="Depth of short guides",
    )  # fmt: skip
    guide_margin: float = live(
        0.2, "m", 0.0, 5.0, "Distance from the end of such a guide to the range of its fine cell.",
    )  # fmt: skip
    guide_min: float = live(
        0.6, "m", 0.0, 30.0, "Smallest length of such a guide.", label="Shortest guide",
    )  # fmt: skip
    patience: float = live(
        0.15, "s", 0.05, 10.0, "Time without progress toward the goal after which the place is remembered."
    )
    progress: float = live(
        0.3, "m", 0.01, 10.0, "Decrease of the distance to the goal that counts as progress; at most a third of what "
        "the speed limit allows in the time of patience.",
    )  # fmt: skip
