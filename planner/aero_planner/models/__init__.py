"""The vehicle models: what the controls are, and how the state follows them.

Anybody can bring one: see `examples/own_model.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_planner.models.vehicle_model import VehicleModel

__all__ = ["VehicleModel"]

__getattr__, __dir__ = lazy_exports(__name__, {"vehicle_model": ("VehicleModel",)})
