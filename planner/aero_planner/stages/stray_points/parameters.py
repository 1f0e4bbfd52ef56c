"""Parameters of the stray points: none. `stages.active` decides whether they are removed."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection


@dataclass(frozen=True)
class Parameters(ParameterSection, section="stray_points"):
    """Stray points: what is removed follows from the density of the sweeps alone."""
