"""Parameters of dynamic obstacles."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, switch


@dataclass(frozen=True)
class Parameters(ParameterSection, section="moving_obstacles"):
    """Dynamic obstacles: tracked from sweep to sweep, and predicted."""

    predict: bool = switch(
        True, "Estimate the velocities of obstacles from successive sweeps, and keep clear of their predicted "
        "positions.",
        label="Predict motion",
    )  # fmt: skip
