"""Closed-loop flights: one headless, one behind the dashboard, or hundreds in one batch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.flight.batch import FlightBatch
    from aero_viz.flight.interrupt import FlightInterrupted
    from aero_viz.flight.metrics import FlightResult
    from aero_viz.flight.rules import FlightRules
    from aero_viz.flight.simulator import Simulator
    from aero_viz.flight.single import fly
    from aero_viz.flight.source import FlightSource
    from aero_viz.flight.state_noise import StateNoise
    from aero_viz.flight.vehicle_model import VehicleModel

__all__ = [
    "FlightBatch",
    "FlightInterrupted",
    "FlightResult",
    "FlightRules",
    "FlightSource",
    "Simulator",
    "StateNoise",
    "VehicleModel",
    "fly",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "batch": ("FlightBatch",),
        "interrupt": ("FlightInterrupted",),
        "metrics": ("FlightResult",),
        "rules": ("FlightRules",),
        "simulator": ("Simulator",),
        "single": ("fly",),
        "source": ("FlightSource",),
        "state_noise": ("StateNoise",),
        "vehicle_model": ("VehicleModel",),
    },
)
