"""Closed-loop flights: one headless, one behind the dashboard, or hundreds in one batch."""

from __future__ import annotations

from aero_viz.flight.batch import FlightBatch
from aero_viz.flight.estimate import StateNoise
from aero_viz.flight.interrupt import FlightInterrupted
from aero_viz.flight.metrics import FlightResult
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.simulator import Simulator
from aero_viz.flight.single import fly
from aero_viz.flight.source import FlightSource
from aero_viz.flight.vehicle import VehicleModel

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
