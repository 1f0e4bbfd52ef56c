"""AERO-MPPI: an anchor-guided ensemble of MPPI optimizers for LiDAR quadrotors, in NVIDIA Warp."""

import sys

from aero_planner.import_path import leave_current_folder

if getattr(sys, "argv", None) and sys.argv[0] == "-m":  # "python -m" is looking for a module of this package
    leave_current_folder()

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_planner.config import PlannerConfig
    from aero_planner.deploy.aot import compile_ahead, warmup
    from aero_planner.plan import BatchPlan, Goal, Plan, PlanStatus, VehicleState
    from aero_planner.planner import Planner
    from aero_planner.sweeps import Arrival, Sweeps

__all__ = [
    "Arrival",
    "BatchPlan",
    "Goal",
    "Plan",
    "PlanStatus",
    "Planner",
    "PlannerConfig",
    "Sweeps",
    "VehicleState",
    "compile_ahead",
    "warmup",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "config": ("PlannerConfig",),
        "plan": ("BatchPlan", "Goal", "Plan", "PlanStatus", "VehicleState"),
        "planner": ("Planner",),
        "sweeps": ("Arrival", "Sweeps"),
        "deploy.aot": ("compile_ahead", "warmup"),
    },
)
