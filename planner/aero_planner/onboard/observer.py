"""What the node tells those who look on: the flight log and the viewers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.point_source import PointPacket
from aero_planner.onboard.safety_machine import Cause, Change, State
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.plan import Plan, VehicleState

__all__ = ["Observer", "PlanRecord"]


@dataclass(frozen=True, eq=False)
class PlanRecord:
    """One plan and what it was made from."""

    number: int
    """Counts the plans."""
    time: float
    """When the planner was called, host time [s]."""
    state: VehicleState
    """State planned from: the measured one, carried on to when the plan was expected to be ready."""
    measured: VehicleState
    """Newest measured state."""
    goal: NDArray[np.float64]
    """[m], shape [3], world frame."""
    points: NDArray[np.float32]
    """Cloud [m], shape [P, 3], world frame; not to be written to."""
    cloud_age: float
    """[s]"""
    plan: Plan
    plan_ms: float
    """From the call to the plan [ms]."""
    safety: State
    missing: tuple[Cause, ...] = ()
    """What stands against flying the plan."""
    late_ticks: int = 0
    """Deadlines that the control loop has missed since the start."""
    sweeps: int = 10
    """Number of sweeps that the cloud is made of."""


class Observer:
    """Someone who looks on. Every method returns at once, whatever happens."""

    def plan(self, record: PlanRecord) -> None:
        """A plan was made. Called by the planning thread."""

    def change(self, change: Change) -> None:
        """The safety state changed. Called by the control thread."""

    def sample(self, sample: VehicleSample) -> None:
        """The vehicle's state was received. Called by the control thread."""

    def points(self, packet: PointPacket) -> None:
        """Points were received. Called by the control thread."""

    def close(self) -> None:
        """The node has ended."""
