"""Facts that the planner of a simulated flight knows: the field of view, the delay, and the top of the airspace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from aero_planner.config import DroneConfig, PlannerConfig, Value
from aero_planner.config.field_of_view import View, format_views
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.models import LidarModel
from aero_viz.session.source import SourceInfo

Config = TypeVar("Config", bound=DroneConfig)
_FACTS = ("view", "range_max", "delay", "height_max")
"""Names of the parameters that are facts of a flight, in whatever section of a configuration."""


def config_for_drone(config: Config, *, lidar: LidarModel, vehicle: VehicleModel, world: World | None = None) -> Config:
    """Return `config` with the facts of a flight in place of default values.

    The facts are the field of view of `lidar`, see `LidarModel.view`, its range, if that is less than the configuration
    counts on, the delay of `vehicle`, and the top of `world`. Of several sensors, a planner knows the view of the first
    one and the largest view of the others. The
    delay is the latency, plus the time constant of the body rates unless `config` models their lag. The planner must
    know the top because a flight that leaves the bounds has failed, and a LiDAR does not see them. Like the height of
    the ground, the top is used only with costs.use_ground.
    """
    return _with_facts(config, _facts(config, lidar=lidar, vehicle=vehicle, world=world))


def config_for_flight(config: Config, flight: SourceInfo) -> Config:
    """Return `config` with the facts of a `FlightSource`, see `config_for_drone`; unchanged for a recording."""
    return _with_facts(config, _known(config, flight))


def config_without_facts(config: DroneConfig, flight: SourceInfo) -> DroneConfig:
    """Return `config` with default values in place of the facts of a flight: the inverse of `config_for_flight`."""
    default, known = type(config)(), _known(config, flight)
    return config.replace(
        {path: default.get(path) for path in _paths(config).values() if config.get(path) == known[path]}
    )


def config_for_next_flight(config: DroneConfig, *, before: SourceInfo, after: SourceInfo) -> DroneConfig:
    """Return `config` with the facts of the flight `after` in place of those of `before`."""
    return config_for_flight(config_without_facts(config, before), after)


def facts_after(changes: Mapping[str, Any], *, config: DroneConfig, flight: SourceInfo) -> dict[str, Any]:
    """Return the facts of a flight that some changes of `config` bring about, also for those that they reset.

    Some facts depend on other parameters: the top of the world on costs.use_ground, the delay on the lags of the rates.
    A value that was chosen in place of a fact stays.

    Raises:
        ValueError: a parameter is unknown or out of its bounds.
    """
    default = type(config)()
    before, after = _known(config, flight), _known(config.replace(changes), flight)
    facts = {
        path: after[path]
        for path in _paths(config).values()
        if after[path] != before[path] and config.get(path) == before[path]
    }
    chosen = {path: value for path, value in changes.items() if value != default.get(path)}
    return facts | {path: chosen.get(path, after[path]) for path in _paths(config).values() if path in changes}


def _with_facts(config: Config, facts: Mapping[str, Value]) -> Config:
    """Return `config` with facts in place of default values; a value that was chosen stays."""
    default = type(config)()
    return config.replace({path: value for path, value in facts.items() if config.get(path) == default.get(path)})


def _known(config: DroneConfig, flight: SourceInfo) -> dict[str, Value]:
    """Return all facts of a flight, with default values for what is unknown. They need not fit to what was chosen."""
    default = type(config)()
    known = {path: default.get(path) for path in _paths(config).values()}
    if not flight.closed_loop or "lidar" not in flight.settings:
        return known
    settings = FlightSettings.from_dict(flight.settings)
    return known | _facts(config, lidar=settings.lidar, vehicle=settings.drone, world=flight.world)


def _facts(config: DroneConfig, *, lidar: LidarModel, vehicle: VehicleModel, world: World | None) -> dict[str, Value]:
    paths, (view, *others) = _paths(config), (sensor.view for sensor in lidar.sensors)
    facts: dict[str, Value] = {
        "view": format_views((view, *sorted(others, key=_extent)[-1:])),
        "delay": config.vehicle.unmodelled_delay(rate_lag=vehicle.rate_lag, latency=vehicle.latency),
    }
    if world is not None and (not isinstance(config, PlannerConfig) or config.costs.use_ground):
        facts["height_max"] = float(world.bounds[1, 2])
    if "range_max" in paths:
        reach = max(1.0, *(sensor.range_max for sensor in lidar.sensors))
        facts["range_max"] = min(float(type(config)().get(paths["range_max"])), reach)
    return {paths[name]: value for name, value in facts.items() if name in paths}


def _extent(view: View) -> float:
    return (view.highest - view.lowest) * view.width


def _paths(config: DroneConfig) -> dict[str, str]:
    """Return the path of each fact that a configuration has a parameter for, by its name."""
    return {info.name: info.path for info in config.parameters() if info.name in _FACTS}
