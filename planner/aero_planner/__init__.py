"""AERO-MPPI: an anchor-guided ensemble of MPPI optimizers for LiDAR quadrotors, in NVIDIA Warp."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aero_planner.ahead import compile_ahead, warmup
    from aero_planner.config import PlannerConfig
    from aero_planner.plan import Goal, Plan, PlanStatus, VehicleState
    from aero_planner.planner import Planner

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

_HOMES = {
    "config": ("PlannerConfig",),
    "plan": ("Goal", "Plan", "PlanStatus", "VehicleState"),
    "planner": ("Planner",),
    "ahead": ("compile_ahead", "warmup"),
}


def __getattr__(name: str) -> Any:
    """Import a name from its home when it is first asked for: the command line starts, and ends, without Warp."""
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
