"""Settings of a flight: its models, rules, seed and device, and their plain values in a log."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from aero_viz.flight.rules import FlightRules
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.sensors.models import LIDARS, LidarModel


@dataclass(frozen=True)
class FlightSettings:
    """Settings that reproduce a flight, together with its world, goals and configurations."""

    seed: int = 0
    device: str = "cpu"
    lidar: LidarModel = LIDARS["mid360"]
    drone: VehicleModel = field(default_factory=VehicleModel)
    noise: StateNoise | None = None
    """None gives the planner the true state."""
    rules: FlightRules = field(default_factory=FlightRules)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> FlightSettings:
        """Return the settings with these values, as `to_dict` writes them; those that are absent have their defaults.

        Raises:
            TypeError: the values are not those of a flight.
            ValueError: a value is out of its bounds.
        """
        fields: dict[str, Any] = {name: values[name] for name in ("seed", "device") if name in values}
        models = {"lidar": LidarModel, "drone": VehicleModel, "noise": StateNoise, "rules": FlightRules}
        for name, model in models.items():
            if values.get(name) is not None:
                fields[name] = _model(model, values[name])
        return cls(**fields)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as values that JSON can hold."""
        return dataclasses.asdict(self)


def _model(kind: type[Any], values: Mapping[str, Any]) -> Any:
    """Return a model of its values; JSON has lists in place of tuples, and mappings in place of further sensors."""
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in dict(values).items()}
    if "others" in fields:
        fields["others"] = tuple(_model(kind, other) for other in fields["others"])
    return kind(**fields)
