"""Parameters of the simulated vehicle."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from aero_planner import registry
from aero_planner.config import DroneConfig, VehicleConfig
from aero_planner.parameters import ParameterSection, live

PLANNED = ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max")
"""Parameters that the planner's model of the vehicle shares; by default, both have the same values."""


def _planned(name: str) -> Any:
    """Return the field of a parameter that the planner's model of the vehicle shares."""
    planned = VehicleConfig.__dataclass_fields__[name]
    return field(default=planned.default, metadata=planned.metadata)


@dataclass(frozen=True)
class VehicleModel(ParameterSection, section="drone"):
    """Parameters of the simulated vehicle.

    The defaults are the planner's own model, without lags, latency, drag and gusts. What its commands are follows from
    the vehicle model of the planner, see `commanded_by`.

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one.
    """

    mass: float = _planned("mass")
    gravity: float = _planned("gravity")
    thrust_min: float = _planned("thrust_min")
    thrust_max: float = _planned("thrust_max")
    rate_xy_max: float = _planned("rate_xy_max")
    rate_z_max: float = _planned("rate_z_max")
    thrust_lag: float = live(0.0, "s", 0.0, 10.0, "Time constant of the thrust's first-order response; 0 for none.")
    rate_lag: float = live(0.0, "s", 0.0, 10.0, "Time constant of the body rates' first-order response; 0 for none.")
    attitude_gain: float = live(
        12.0, "1/s", 0.1, 100.0, "Gain from the error of the tilt to body rates, in the autopilot of a drone that is "
        "commanded by its acceleration, see vehicle.model.",
    )  # fmt: skip
    drag: float = live(0.0, "1/s", 0.0, 100.0, "Linear drag in dv = .. - k (v - w), with w the wind.", symbol="k")
    latency: float = live(
        0.0, "s", 0.0, 10.0, "Time from a command to its effect, rounded to whole integration steps.", label="Latency"
    )
    gust_speed: float = live(
        0.0, "m/s", 0.0, 100.0, "Standard deviation of the wind along each axis; it acts through the drag.", symbol="w"
    )
    gust_time: float = live(
        1.0, "s", 1e-3, 1e9, "Correlation time of the wind, a first-order process dw = -w / gust_time dt + noise: the "
        "longitudinal form of the Dryden spectrum with gust_time = L / V.",
    )  # fmt: skip
    step: float = live(0.005, "s", 1e-4, 0.1, "Longest integration step.")
    model: str = "ctbr"
    """Vehicle model of the planner that commands it, see `plants.plant_of`."""
    own: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Values of the parameters that this vehicle model brings, by name; defaults where they are absent."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thrust_min > self.thrust_max:
            raise ValueError(f"drone.thrust_min is {self.thrust_min:g} N; it must not exceed drone.thrust_max, "
                             f"which is {self.thrust_max:g} N.")  # fmt: skip
        if self.gust_speed > 0.0 and self.drag == 0.0:
            raise ValueError("drone.gust_speed has no effect without drag; set drone.drag too, such as 0.3 1/s.")

    @classmethod
    def from_config(cls, config: DroneConfig, **changes: float) -> VehicleModel:
        """Return the vehicle that the planner of `config` assumes, with `changes` of its parameters."""
        planned: dict[str, Any] = {name: getattr(config.vehicle, name) for name in PLANNED}
        planned.update(changes)
        return cls(**planned).commanded_by(config)

    def commanded_by(self, config: DroneConfig) -> VehicleModel:
        """Return this vehicle with commands as the vehicle model of `config` has them."""
        section = registry.load("models", config.vehicle.model).parameters
        own: dict[str, float] = {}
        if section is not None and section.section in config.sections():
            own = dataclasses.asdict(getattr(config, section.section))
        return dataclasses.replace(self, model=config.vehicle.model, own=own)
