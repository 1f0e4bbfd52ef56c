"""Parameters of the choice between candidates: safety and braking."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, switch


@dataclass(frozen=True)
class CandidateConfig(ParameterSection, section="candidates"):
    """Candidates in addition to the anchors, and the selection among all candidates."""

    previous: bool = switch(
        True, "Add the previous best plan as a candidate, shifted in time and without the tracking cost, so that the "
        "drone stays on a path once found.",
        live=False, label="Previous plan",
    )  # fmt: skip
    safe_clearance: float = live(
        0.30,
        "m",
        0.0,
        5.0,
        "Clearance below which a candidate is unsafe: the radius of the drone plus a margin.",
        basic=True,
    )
    speed_margin: float = live(
        0.01, "s", 0.0, 0.5, "Addition to the clearances of candidates and stops per speed: a fast drone follows its "
        "plan less closely. 0 as in the paper.",
        label="Margin per speed",
    )  # fmt: skip
    prefer_safe: bool = switch(
        True, "Select the cheapest safe candidate, and brake if no candidate is safe. Off as in the paper: the "
        "candidate with the lowest S2 is selected, and the drone brakes if it is unsafe.",
        label="Prefer safe candidates",
    )  # fmt: skip
    brake_reach: float = live(
        0.33, "", 0.1, 1.0, "Length of the braking guide as a fraction of v T; smaller values brake harder.",
        label="Braking distance factor",
    )  # fmt: skip
