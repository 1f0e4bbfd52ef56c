"""Conditions of a flight that a user chooses before it is opened: the LiDAR, the noise and the wind."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from aero_planner.config import ParameterInfo
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.sensors.models import LIDARS, LidarModel, lidar_model
from aero_viz.session.source import Conditions

if TYPE_CHECKING:
    from aero_viz.flight.simulator import Setting

_NAMES = {StateNoise: ("position", "velocity", "attitude"), VehicleModel: ("drag", "gust_speed")}
OFFERED: tuple[ParameterInfo, ...] = tuple(
    info for section, names in _NAMES.items() for info in section.parameters() if info.name in names
)
"""The parameters of the noise and of the drone that `Conditions.values` may hold."""


_LIVE = {
    StateNoise: _NAMES[StateNoise],
    VehicleModel: (*_NAMES[VehicleModel], "latency"),
    LidarModel: ("range_noise", "dropout", "strays", "sweep_loss"),
}
LIVE: tuple[ParameterInfo, ...] = tuple(
    info for section, names in _LIVE.items() for info in section.parameters() if info.name in names
)
"""The parameters that may change during a flight: errors of the estimate, wind, latency, and faults of the LiDAR."""
_FIELDS = {"noise": "noise", "drone": "vehicle", "lidar": "lidar"}
"""Names in `Setting` of the sections of `LIVE`."""


def live_conditions(setting: Setting) -> dict[str, Any]:
    """Return the values of `LIVE` in a setting, by path."""
    sections = {"noise": setting.noise or StateNoise(), "drone": setting.vehicle, "lidar": setting.lidar}
    return {info.path: getattr(sections[info.section], info.name) for info in LIVE}


def with_live_conditions(setting: Setting, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a setting that change when parameters of `LIVE` get these values, by path.

    Raises:
        ValueError: a value is out of its bounds, contradicts another one, or cannot be changed.
    """
    changes: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        info = next((info for info in LIVE if info.path == path), None)
        if info is None:
            raise ValueError(f"{path} cannot change during a flight; {', '.join(info.path for info in LIVE)} can.")
        changes.setdefault(_FIELDS[info.section], {})[info.name] = info.check(value)
    return {
        field: dataclasses.replace(getattr(setting, field) or StateNoise(), **fields)
        for field, fields in changes.items()
    }


def conditions_of(options: Mapping[str, Any], *, count: int | None = None) -> Conditions:
    """Return the conditions that the arguments lidar, vehicle and noise of `FlightSource` describe."""
    sections = {"noise": options["noise"] or StateNoise(), "drone": options["vehicle"]}
    values = {info.path: getattr(sections[info.section], info.name) for info in OFFERED}
    return Conditions(count=count, lidar=options["lidar"].name, values=values)


def with_conditions(options: Mapping[str, Any], conditions: Conditions) -> dict[str, Any]:
    """Return arguments of `FlightSource` whose lidar, vehicle and noise are those of the conditions.

    Args:
        options: arguments of `FlightSource`, with lidar, vehicle and noise.
        conditions: conditions to set. The LiDAR of `options` stays, with its changes, if they name it.

    Raises:
        ValueError: a value is out of its bounds, contradicts another one, or cannot be chosen.
        UserError: there is no such LiDAR.
    """
    lidar = options["lidar"] or LIDARS["mid360"]
    if conditions.lidar not in (None, lidar.name):
        lidar = lidar_model(conditions.lidar)
    known = {info.path: info for info in OFFERED}
    changes: dict[str, dict[str, Any]] = {"noise": {}, "drone": {}}
    for path, value in conditions.values.items():
        if path not in known:
            raise ValueError(f"{path} is not a condition of a flight; give one of {', '.join(known)}.")
        changes[known[path].section][known[path].name] = value
    noise = dataclasses.replace(options["noise"] or StateNoise(), **changes["noise"])
    is_exact = not any((noise.position, noise.velocity, noise.attitude))
    vehicle = dataclasses.replace(options["vehicle"], **changes["drone"])
    return {**options, "lidar": lidar, "vehicle": vehicle, "noise": None if is_exact else noise}
