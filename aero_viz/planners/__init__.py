"""Planners: what every one of them does, what it returns, and how one is found by its name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_planner.config import DroneConfig
    from aero_viz.planners.observation import Observation
    from aero_viz.planners.plan import CandidatePlan, Plan
    from aero_viz.planners.planner import Planner, PlannerError
    from aero_viz.planners.registry import PLANNERS, load, make, name_of

__all__ = [
    "PLANNERS",
    "CandidatePlan",
    "DroneConfig",
    "Observation",
    "Plan",
    "Planner",
    "PlannerError",
    "load",
    "make",
    "name_of",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "observation": ("DroneConfig", "Observation"),
        "plan": ("CandidatePlan", "Plan"),
        "planner": ("Planner", "PlannerError"),
        "registry": ("PLANNERS", "load", "make", "name_of"),
    },
)
