"""Observers of the node, such as the flight log and the telemetry server, and the record of a plan that they get."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.point_source import PointPacket
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.plan import Plan, VehicleState

__all__ = ["Observer", "PlanRecord"]


@dataclass(frozen=True, eq=False)
class PlanRecord:
    """One plan, its inputs, and the state of the node."""

    number: int
    """Counts the plans."""
    time: float
    """When the planner was called, host time [s]."""
    state: VehicleState
    """State from which the plan starts: the measured state, predicted for when the plan was expected to be ready."""
    measured: VehicleState
    """Newest measured state."""
    goal: NDArray[np.float64]
    """[m], shape [3], world frame."""
    points: NDArray[np.float32]
    """Cloud [m], shape [P, 3], world frame; must not be modified."""
    cloud_age: float
    """Age of the newest point [s]."""
    plan: Plan
    plan_ms: float
    """Duration of the planner's call [ms]."""
    safety: State
    faults: tuple[Cause, ...] = ()
    """Faults that prevent flying the plan."""
    late_ticks: int = 0
    """Number of deadlines that the control loop has missed since the start."""
    sweeps: int = 10
    """Number of sweeps in the cloud."""


class Observer:
    """Base class of observers. Every method must return at once and must not raise."""

    def plan(self, record: PlanRecord) -> None:
        """Receive a plan. Called by the planning thread."""

    def change(self, change: StateChange) -> None:
        """Receive a transition of the safety state. Called by the control thread."""

    def sample(self, sample: VehicleSample) -> None:
        """Receive a vehicle state. Called by the control thread."""

    def points(self, packet: PointPacket) -> None:
        """Receive points. Called by the control thread."""

    def close(self) -> None:
        """Release resources; the node has ended."""
