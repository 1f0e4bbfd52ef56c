"""Parameters of LiDARs and depth cameras, and the models by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.config.field_of_view import View, mounted_view
from aero_planner.parameters import ParameterSection, choice, live, structural
from aero_planner.quaternions import conjugate, quaternion_from_angles, rotate
from aero_viz.errors import UserError
from aero_viz.registry import Registry


@dataclass(frozen=True)
class LidarModel(ParameterSection, section="lidar"):
    """Parameters of a LiDAR or a depth camera that is fixed to the body. By default its frame is the body frame.

    Patterns:

    - "livox": the pattern of a Mid-360. Four beams fire in turn. Together they rotate at 176.4 Hz, each on a ring with
      a slightly different tilt, and the rings swing over the field of view and back at 10.016 Hz:
      e = m + s cos(2 pi 10.016 t) + w_i cos(2 pi 176.4 t), with m the centre of the field of view, w_i = 3.6, 1.2, -1.2
      and -3.6 deg, and s the remaining half height of the field of view.
    - "even": a low-discrepancy sequence that covers the field of view evenly per solid angle.
    - "rings": `rings` beams, evenly spaced in elevation, rotate once per sweep.
    - "pinhole": the pixels of a depth image with `rings` rows, exposed row by row from the top. The tangents of azimuth
      and elevation are evenly spaced, as those of a camera that looks along x.

    The first two never repeat, so that gaps close over time (see `coverage`). Those of a narrow field of view are
    compressed into it, except that of a Livox, which loses what it fires beside it.

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one.
    """

    name: str
    elevation_min: float = live(-7.0, "deg", -90.0, 90.0, "Lower edge of the field of view.")
    elevation_max: float = live(52.0, "deg", -90.0, 90.0, "Upper edge of the field of view.")
    azimuth_min: float = live(-180.0, "deg", -180.0, 180.0, "Right edge of the field of view.")
    azimuth_max: float = live(180.0, "deg", -180.0, 180.0, "Left edge of the field of view.")
    points_per_sweep: int = structural(20_000, 1, 1_000_000, "Rays per sweep.")
    sweep_rate: float = live(10.0, "Hz", 0.1, 1000.0, "Sweeps per second.")
    range_min: float = live(0.1, "m", 0.0, 100.0, "Surfaces nearer than this return no point.")
    range_max: float = live(40.0, "m", 0.1, 1000.0, "Surfaces farther than this return no point.")
    range_noise: float = live(0.02, "m", 0.0, 10.0, "Standard deviation of the range.")
    dropout: float = live(0.02, "", 0.0, 1.0, "Fraction of the returns that are lost.")
    strays: float = live(
        0.0, "", 0.0, 1.0, "Fraction of the rays that end in the air within `stray_range`: at rain, dust or insects.",
        label="Stray points",
    )  # fmt: skip
    stray_range: float = live(1.0, "m", 0.0, 100.0, "Radius of the ball that stray points fill evenly.")
    sweep_loss: float = live(0.0, "", 0.0, 1.0, "Fraction of the sweeps that are lost as a whole.", label="Lost sweeps")
    pattern: str = choice("even", ("livox", "even", "rings", "pinhole"), "Scan pattern.")
    rings: int = structural(64, 1, 1024, "Number of beams of the pattern 'rings', or of rows of the pattern 'pinhole'.")
    mount_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the sensor, body frame [m]."""
    mount_angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw from sensor to body, R = R_z(yaw) R_y(pitch) R_x(roll) [deg]; (180, 0, 0) is upside down."""
    others: tuple[LidarModel, ...] = ()
    """Further sensors of the drone. Their rays belong to the sweeps of this one; each has its rate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (
            ("elevation_min", "elevation_max"), ("azimuth_min", "azimuth_max"), ("range_min", "range_max")
        ):  # fmt: skip
            lower, upper = getattr(self, low), getattr(self, high)
            if lower >= upper:
                raise ValueError(f"lidar.{low} is {lower:g}; it must be less than lidar.{high}, which is {upper:g}.")
        if self.pattern == "pinhole":
            for name in ("elevation_min", "elevation_max", "azimuth_min", "azimuth_max"):
                if abs(getattr(self, name)) >= 90.0:
                    raise ValueError(f"lidar.{name} is {getattr(self, name):g}; an image ends before 90 deg.")
        if self.pattern in ("rings", "pinhole") and self.points_per_sweep % self.rings:
            raise ValueError(f"lidar.rings is {self.rings}; it must divide lidar.points_per_sweep, which is "
                             f"{self.points_per_sweep}.")  # fmt: skip
        for name in ("mount_position", "mount_angles"):
            value = getattr(self, name)
            if len(value) != 3 or not all(map(math.isfinite, value)):
                raise ValueError(f"lidar.{name} is {value!r}; it must be three finite numbers.")

    @property
    def view(self) -> View:
        """The field of view in the body frame, as a planner knows it."""
        roll, pitch, yaw = self.mount_angles
        middle = 0.5 * (self.azimuth_min + self.azimuth_max)
        view = View(self.elevation_min, self.elevation_max, self.azimuth_max - self.azimuth_min, middle)
        return mounted_view(view, roll=roll, pitch=pitch, yaw=yaw)

    @property
    def is_blind(self) -> bool:
        """True if it loses practically every return; rays into the open return none, and that says something."""
        return self.points_per_sweep * (1.0 - self.dropout) < 1.0

    @property
    def sensors(self) -> tuple[LidarModel, ...]:
        """This sensor and the others."""
        return (self, *self.others)

    def rays_of(self, sensor: LidarModel) -> float:
        """Return the mean number of rays of one of the sensors in a sweep of this one."""
        return sensor.points_per_sweep * (sensor.sweep_rate / self.sweep_rate)

    @property
    def rays_per_sweep(self) -> int:
        """Number of rays in a sweep, those of the other sensors included."""
        return sum(math.floor(self.rays_of(sensor)) for sensor in self.sensors)

    def sees(self, directions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether directions in the body frame, [N, 3], are in the field of view of one of the sensors, [N]."""
        x, y, z = rotate(conjugate(quaternion_from_angles(*self.mount_angles)), directions).T
        azimuth = np.degrees(np.arctan2(y, x))
        # An image has a straight upper edge: elevations are those in the plane of its middle column.
        elevation = np.degrees(np.arctan2(z, x if self.pattern == "pinhole" else np.hypot(x, y)))
        seen = (azimuth >= self.azimuth_min) & (azimuth <= self.azimuth_max)
        seen &= (elevation >= self.elevation_min) & (elevation <= self.elevation_max)
        return np.any([seen, *(sensor.sees(directions) for sensor in self.others)], axis=0)

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
    LidarModel(
        "d435", elevation_min=-29.0, elevation_max=29.0, azimuth_min=-43.5, azimuth_max=43.5, points_per_sweep=49 * 84,
        sweep_rate=30.0, range_min=0.3, range_max=6.0, pattern="pinhole", rings=49,
    ),
)  # fmt: skip


def _accept(name: str, found: Any) -> LidarModel:
    if not isinstance(found, LidarModel):
        raise UserError(f"{name} is not a LiDAR; give a LidarModel.")
    return replace(found, name=name)


LIDARS: Registry[LidarModel] = Registry(
    "LiDAR",
    "aero_viz.sensors",
    {model.name: model for model in _MODELS},
    _accept,
    others="module:attribute; a + joins several",
)
"""By name: the Livox Mid-360, a sensor of its rate without blind zones, a spinning sensor with 64 rings, and a depth
camera RealSense D435, of whose image every tenth row and column is kept."""


def admit_lidars(text: str) -> str:
    """Import what a user names by its place, see `lidar_model` and `Registry.admit`; return the text."""
    for part in text.split("+"):
        LIDARS.admit(part.partition("@")[0])
    return text


def lidar_model(name: str) -> LidarModel:
    """Return a model by name, or several on one drone, such as "mid360+d435" or "d435+d435@180".

    A number after @ turns a sensor to the left [deg]; it is added to the yaw of its mount.

    Raises:
        UserError: there is no such model; the message lists all.
    """
    first, *others = (_turned_model(part) for part in name.split("+"))
    return replace(first, name=name, others=tuple(others)) if others else first


def _turned_model(text: str) -> LidarModel:
    """Return the model that "NAME" or "NAME@YAW" describes."""
    name, at, turn = text.partition("@")
    model = LIDARS.known(name)
    if not at:
        return model
    try:
        roll, pitch, yaw = model.mount_angles
        return replace(model, name=text, mount_angles=(roll, pitch, yaw + float(turn)))
    except ValueError:
        raise UserError(f"{text!r} turns {name} by {turn!r}; give degrees to the left, such as {name}@180.") from None
