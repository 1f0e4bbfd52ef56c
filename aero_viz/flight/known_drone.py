"""What the planner of a simulated flight knows about its drone: the field of view of the sensor, and the delay."""

from __future__ import annotations

from aero_planner import PlannerConfig
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.sensors.lidar import LidarModel

__all__ = ["config_for_drone", "config_for_next_lidar"]

_UPRIGHT, _INVERTED = (0.0, 0.0), (180.0, 0.0)


def config_for_drone(config: PlannerConfig, *, lidar: LidarModel, vehicle: VehicleModel) -> PlannerConfig:
    """Return `config` with the field of view of `lidar` and the delay of `vehicle` where it has the default values.

    The delay is the latency, plus the time constant of the body rates unless `config` models their lag. A sensor that
    is neither upright nor upside down has no lower edge of its view that could be continued.
    """
    default = PlannerConfig()
    roll_and_pitch = (abs(lidar.mount_angles[0]), abs(lidar.mount_angles[1]))
    view = (-90.0, 90.0)
    if roll_and_pitch == _UPRIGHT:
        view = (lidar.elevation_min, lidar.elevation_max)
    elif roll_and_pitch == _INVERTED:
        view = (-lidar.elevation_max, -lidar.elevation_min)
    unmodelled_lag = vehicle.rate_lag if config.vehicle.rate_xy_lag == 0.0 else 0.0
    known = {
        "partition.view_min": view[0],
        "partition.view_max": view[1],
        "vehicle.delay": min(vehicle.latency + unmodelled_lag, 0.5),
    }
    return config.replace({path: value for path, value in known.items() if config.get(path) == default.get(path)})


def config_for_next_lidar(config: PlannerConfig, *, before: LidarModel, after: LidarModel) -> PlannerConfig:
    """Return `config` with the field of view of the LiDAR `after` where it has that of `before`."""
    vehicle = VehicleModel.from_config(config)
    old, new = (config_for_drone(PlannerConfig(), lidar=lidar, vehicle=vehicle) for lidar in (before, after))
    paths = ("partition.view_min", "partition.view_max")
    if any(config.get(path) != old.get(path) for path in paths):
        return config  # chosen by the user
    return config.replace({path: new.get(path) for path in paths})
