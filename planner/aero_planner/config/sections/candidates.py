"""Parameters of the choice between candidates: safety, proven stops and braking."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.config.parameter import ParameterSection, choice, live, switch


@dataclass(frozen=True)
class CandidateConfig(ParameterSection, section="candidates"):
    """Candidates in addition to the anchors, and the selection among all candidates."""

    previous: bool = switch(
        True, "Add the previous best plan as a candidate, shifted in time and without the tracking cost, so that the "
        "drone stays on a path once found.",
        live=False, label="Previous plan",
    )  # fmt: skip
    brake: bool = switch(
        True, "Add a braking candidate, for when every other candidate crosses an obstacle.",
        live=False, label="Braking candidate",
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
    between_steps: bool = switch(
        True, "Also check the clearance halfway between two time steps, which are 0.35 m apart at 7 m/s.",
        label="Check between time steps",
    )  # fmt: skip
    prefer_safe: bool = switch(
        True, "Select the cheapest safe candidate, and brake if no candidate is safe. Off as in the paper: the "
        "candidate with the lowest S2 is selected, and the drone brakes if it is unsafe.",
        label="Prefer safe candidates", basic=True,
    )  # fmt: skip
    prove_stop: str = choice(
        "instead", ("off", "required", "instead"),
        "Fly a candidate only while a clear stop remains, a braking manoeuvre now or later. Otherwise fly the stop "
        "proven last, while that is clear of static obstacles. Instead: the candidate need not be clear "
        "beyond its stop.",
        label="Proven stop",
    )  # fmt: skip
    widest_stop: bool = switch(
        True, "If no candidate has a clear stop and no braking is clear either, fly the candidate whose stop keeps the "
        "largest clearance, unless that is less than half of stop_clearance. Only with prefer_safe, and if prove_stop "
        "is 'instead'.",
        label="Widest stop",
    )  # fmt: skip
    stop_clearance: float = live(
        0.28, "m", 0.0, 5.0, "Clearance of a proven stop, at most safe_clearance.", label="Clearance of a stop"
    )
    stop_seen: bool = switch(
        True, "A proven stop lies in space that is seen from the drone: not behind the nearest point of a fine cell.",
        label="Stop in seen space",
    )  # fmt: skip
    stop_seen_closing: bool = switch(
        True, "A fine cell between nearer ones on both sides, or above and below, is seen as far as the farther of "
        "these: no beam may have hit the surface there.",
        label="Close holes in surfaces",
    )  # fmt: skip
    stop_speed: float = live(
        1.0, "m/s", 0.0, 50.0, "Speed below which a braking manoeuvre counts as a stop at its end.",
        label="Speed after a stop",
    )  # fmt: skip
    brake_reach: float = live(
        0.33, "", 0.1, 1.0, "Length of the braking guide as a fraction of v T; smaller values brake harder.",
        label="Braking distance factor",
    )  # fmt: skip
    brake_seen: bool = switch(
        True, "A braking candidate that leads into space that is not seen from the drone is not clear: a stop that was "
        "proven is flown instead.",
        label="Braking in seen space",
    )  # fmt: skip
    brake_fan: float = live(
        30.0, "deg", 0.0, 45.0, "Angle between the five braking candidates, of which the one with the largest "
        "clearance is flown, among those that are clear of static obstacles: there may be one straight ahead. 0 "
        "brakes straight ahead only.",
        label="Braking fan angle",
    )  # fmt: skip
