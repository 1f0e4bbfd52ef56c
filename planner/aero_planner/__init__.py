"""AERO-MPPI: an anchor-guided ensemble of MPPI optimizers for LiDAR quadrotors, in NVIDIA Warp."""

from __future__ import annotations

from aero_planner.config import PlannerConfig
from aero_planner.plan import Goal, Plan, PlanStatus, VehicleState
from aero_planner.planner import Planner
from aero_planner.warmup import compile_ahead, warmup

__all__ = [
    "Goal",
    "Plan",
    "PlanStatus",
    "Planner",
    "PlannerConfig",
    "VehicleState",
    "compile_ahead",
    "warmup",
]
