"""Parameters of the stop proof."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, switch


@dataclass(frozen=True)
class Parameters(ParameterSection, section="stop_proof"):
    """Stop proof: a backup stop remains that is clear and in seen space."""

    prove_stop: bool = switch(
        True, "Fly a candidate only while a backup stop remains that is clear and in seen space, now or later; the "
        "candidate need not be clear beyond it. Otherwise fly the stop proven last, while that is clear of static "
        "obstacles.",
        label="Prove stops",
    )  # fmt: skip
    stop_clearance: float = live(
        0.28, "m", 0.0, 5.0, "Clearance of a backup stop, at most candidates.safe_clearance.",
        label="Clearance of a stop",
    )  # fmt: skip
