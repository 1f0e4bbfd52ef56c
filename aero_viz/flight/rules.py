"""Rules that end a flight, and the names of its outcomes. `flight_end.py` applies them."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, structural

OUTCOMES = (None, "arrived", "collision", "stall", "out_of_bounds", "timeout")
"""Outcomes of a flight by their number on the device; 0 means still flying."""


@dataclass(frozen=True)
class FlightRules(ParameterSection, section="rules"):
    """Conditions that end a flight, in the first tick in which one of them holds. A collision precedes an arrival.

    Raises:
        ValueError: a parameter is outside its bounds.
    """

    period: float = live(
        0.02, "s", 1e-3, 1.0,
        "Duration of a tick, for which one command is held; a sweep of the LiDAR takes at least one tick.",
    )  # fmt: skip
    ticks_per_plan: int = structural(
        1, 1, 1000,
        "Ticks flown under one plan: 1 plans at 50 Hz; 5, as on the drone, plans at 10 Hz and executes at 50 Hz.",
    )  # fmt: skip
    radius: float = live(
        0.25, "m", 1e-3, 100.0,
        "Collision: the centre comes closer than this to a surface, checked at every integration step.",
    )  # fmt: skip
    arrival_radius: float = live(1.0, "m", 1e-3, 1e3, "Arrival: the centre is within this distance of the goal.")
    stall_distance: float = live(
        1.0, "m", 1e-3, 1e3,
        "Stall: the drone has not moved this far, in whatever direction, within stall_time.",
    )  # fmt: skip
    stall_time: float = live(5.0, "s", 1e-3, 1e9, "Time within which the drone must move by stall_distance.")
    time_limit: float = live(60.0, "s", 1e-3, 1e9, "Timeout: this much time has passed since the goal was set.")
