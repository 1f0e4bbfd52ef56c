"""Parameters of the simulated quadrotor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from aero_planner.config import PlannerConfig, VehicleConfig
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

    The defaults are the planner's own model, without lags, latency, drag and gusts.

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

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thrust_min > self.thrust_max:
            raise ValueError(f"drone.thrust_min is {self.thrust_min:g} N; it must not exceed drone.thrust_max, "
                             f"which is {self.thrust_max:g} N.")  # fmt: skip
        if self.gust_speed > 0.0 and self.drag == 0.0:
            raise ValueError("drone.gust_speed has no effect without drag; set drone.drag too, such as 0.3 1/s.")

    @classmethod
    def from_config(cls, config: PlannerConfig, **changes: float) -> VehicleModel:
        """Return the vehicle that the planner of `config` assumes, with `changes` of its parameters."""
        return cls(**{name: getattr(config.vehicle, name) for name in PLANNED} | changes)
