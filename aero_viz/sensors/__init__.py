"""Simulated sensors: LiDAR models and ray casting in Warp."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.sensors.field_coverage import coverage
    from aero_viz.sensors.lidar import Lidar
    from aero_viz.sensors.models import LIDARS, LidarModel, lidar_model
    from aero_viz.sensors.raycast import cast

__all__ = [
    "LIDARS",
    "Lidar",
    "LidarModel",
    "cast",
    "coverage",
    "lidar_model",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "field_coverage": ("coverage",),
        "lidar": ("Lidar",),
        "models": ("LIDARS", "LidarModel", "lidar_model"),
        "raycast": ("cast",),
    },
)
