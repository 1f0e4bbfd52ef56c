"""Selection of the sweeps that the cloud of a flight remembers."""

from __future__ import annotations

from aero_planner import PlannerConfig
from aero_planner.sweeps import sweeps_within
from aero_viz.sensors.models import LidarModel

SWEEPS = 30
"""Number of sweeps that were measured before the start, three seconds of a Mid-360."""
WHOLE_SWEEPS = 10
"""Number of newest sweeps of which the cloud has all points; of older sweeps it has one point in five."""
MOST_SWEEPS = 120
"""Largest number of sweeps in the cloud."""


def remembered_sweeps(memory: float, lidar: LidarModel) -> int:
    """Return how many sweeps are newer than `memory` [s] when one is complete, see `DroneConfig.sweep_memory`."""
    return min(max(sweeps_within(memory, 1.0 / lidar.sweep_rate), 1), MOST_SWEEPS)


DEFAULT_MEMORY = PlannerConfig().sweep_memory
"""Memory of the default configuration [s]."""
