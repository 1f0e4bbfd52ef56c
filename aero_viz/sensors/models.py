"""Parameters of LiDARs, and the models by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.parameters import ParameterSection, choice, live, structural
from aero_viz.errors import UserError
from aero_viz.registry import Registry


@dataclass(frozen=True)
class LidarModel(ParameterSection, section="lidar"):
    """Parameters of a LiDAR that is fixed to the body. By default the sensor frame is the body frame.

    Patterns:

    - "livox": the pattern of a Mid-360. Four beams fire in turn. Together they rotate at 176.4 Hz, each on a ring with
      a slightly different tilt, and the rings swing over the field of view and back at 10.016 Hz:
      e = m + s cos(2 pi 10.016 t) + w_i cos(2 pi 176.4 t), with m the centre of the field of view, w_i = 3.6, 1.2, -1.2
      and -3.6 deg, and s the remaining half height of the field of view.
    - "even": a low-discrepancy sequence that covers the field of view evenly per solid angle.
    - "rings": `rings` beams, evenly spaced in elevation, rotate once per sweep.

    The first two never repeat, so that gaps close over time (see `coverage`).

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one.
    """

    name: str
    elevation_min: float = live(-7.0, "deg", -90.0, 90.0, "Lower edge of the field of view (360 deg in azimuth).")
    elevation_max: float = live(52.0, "deg", -90.0, 90.0, "Upper edge of the field of view.")
    points_per_sweep: int = structural(20_000, 1, 1_000_000, "Rays per sweep.")
    sweep_rate: float = live(10.0, "Hz", 0.1, 1000.0, "Sweeps per second.")
    range_min: float = live(0.1, "m", 0.0, 100.0, "Surfaces nearer than this return no point.")
    range_max: float = live(40.0, "m", 0.1, 1000.0, "Surfaces farther than this return no point.")
    range_noise: float = live(0.02, "m", 0.0, 10.0, "Standard deviation of the range.")
    dropout: float = live(0.02, "", 0.0, 1.0, "Fraction of the returns that are lost.")
    sweep_loss: float = live(0.0, "", 0.0, 1.0, "Fraction of the sweeps that are lost as a whole.", label="Lost sweeps")
    pattern: str = choice("even", ("livox", "even", "rings"), "Scan pattern.")
    rings: int = structural(64, 1, 1024, "Number of beams of the pattern 'rings', evenly spaced in elevation.")
    mount_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the sensor, body frame [m]."""
    mount_angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw from sensor to body, R = R_z(yaw) R_y(pitch) R_x(roll) [deg]; (180, 0, 0) is upside down."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (("elevation_min", "elevation_max"), ("range_min", "range_max")):
            lower, upper = getattr(self, low), getattr(self, high)
            if lower >= upper:
                raise ValueError(f"lidar.{low} is {lower:g}; it must be less than lidar.{high}, which is {upper:g}.")
        if self.pattern == "rings" and self.points_per_sweep % self.rings:
            raise ValueError(f"lidar.rings is {self.rings}; it must divide lidar.points_per_sweep, which is "
                             f"{self.points_per_sweep}.")  # fmt: skip
        for name in ("mount_position", "mount_angles"):
            value = getattr(self, name)
            if len(value) != 3 or not all(map(math.isfinite, value)):
                raise ValueError(f"lidar.{name} is {value!r}; it must be three finite numbers.")

    @property
    def is_blind(self) -> bool:
        """True if it loses practically every return; rays into the open return none, and that says something."""
        return self.points_per_sweep * (1.0 - self.dropout) < 1.0

    def point_times(self) -> NDArray[Any]:
        """Return the time of each point since the start of its sweep [s], [points_per_sweep]."""
        return (np.arange(self.points_per_sweep) + 0.5) / (self.points_per_sweep * self.sweep_rate)

    def sweep_end(self, sweep: int) -> float:
        """Return the time at which a sweep is complete [s]; that of sweep 0 starts at 0."""
        return (sweep + 1) / self.sweep_rate


_MODELS = (
    LidarModel("mid360", pattern="livox"),
    LidarModel("full-sphere", elevation_min=-90.0, elevation_max=90.0),
    LidarModel(
        "spinning64", elevation_min=-22.5, elevation_max=22.5, points_per_sweep=64 * 512, range_max=90.0,
        pattern="rings",
    ),
)  # fmt: skip


def _accept(name: str, found: Any) -> LidarModel:
    if not isinstance(found, LidarModel):
        raise UserError(f"{name} is not a LiDAR; give a LidarModel.")
    return replace(found, name=name)


LIDARS: Registry[LidarModel] = Registry("LiDAR", "aero_viz.sensors", {model.name: model for model in _MODELS}, _accept)
"""By name: the Livox Mid-360, a sensor of its rate without blind zones, and a spinning sensor with 64 rings."""


def lidar_model(name: str) -> LidarModel:
    """Return a model by name.

    Raises:
        UserError: there is no such model; the message lists all.
    """
    return LIDARS.known(name)
