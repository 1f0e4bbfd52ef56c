"""Simulated sensors: LiDAR models and ray casting in Warp."""

from __future__ import annotations

from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.coverage import coverage
from aero_viz.sensors.lidar import LIDARS, Lidar, LidarModel, lidar_model
from aero_viz.sensors.raycast import cast

__all__ = ["LIDARS", "DeviceWorlds", "Lidar", "LidarModel", "cast", "coverage", "lidar_model"]
