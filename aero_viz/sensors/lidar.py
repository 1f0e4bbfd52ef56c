"""LiDAR models, and the simulated sensor with motion within a sweep, noise and dropout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.config.parameter import ParameterSection, choice, did_you_mean, live, structural
from aero_planner.quaternions import quaternion_from_angles
from aero_viz.errors import UserError
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.lidar_kernels import Beams, scan

# The Mid-360, after the scan table that its maker publishes for simulation (livox_laser_simulation, mid360.csv).
_BEAMS = 4
_TURN_RATE = 176.4  # [Hz]
_SWING_RATE = 10.016  # [Hz]
_LOSS = 0x4C6F7373  # separates the random numbers of lost sweeps from others
_TILT = 3.6  # tilt of the rings of the outer beams [deg]


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
LIDARS = {model.name: model for model in _MODELS}
"""By name: the Livox Mid-360, a sensor of its rate without blind zones, and a spinning sensor with 64 rings."""


def lidar_model(name: str) -> LidarModel:
    """Return a model by name.

    Raises:
        UserError: there is no such model; the message lists all.
    """
    if name not in LIDARS:
        raise UserError(f"Unknown LiDAR {name!r}{did_you_mean(name, LIDARS)}; LiDARs: {', '.join(LIDARS)}.")
    return LIDARS[name]


def pack_beams(model: LidarModel) -> Any:
    """Return the `Beams` of a model."""
    beams: Any = Beams()
    beams.elevation_min = math.radians(model.elevation_min)
    beams.elevation_max = math.radians(model.elevation_max)
    beams.height_min, beams.height_max = math.sin(beams.elevation_min), math.sin(beams.elevation_max)
    for name in ("points_per_sweep", "sweep_rate", "range_min", "range_max", "range_noise", "dropout"):
        setattr(beams, name, getattr(model, name))
    if model.pattern == "rings":
        beams.rings = model.rings
    if model.pattern == "livox":
        beams.tilt = min(math.radians(_TILT), 0.25 * (beams.elevation_max - beams.elevation_min))
    shots = model.points_per_sweep * model.sweep_rate / _BEAMS
    beams.turn_step, beams.swing_step = (wp.uint32(_step(rate / shots)) for rate in (_TURN_RATE, _SWING_RATE))
    beams.mount_position = wp.vec3(*model.mount_position)
    w, x, y, z = quaternion_from_angles(*model.mount_angles)
    beams.mount_attitude = wp.quat(x, y, z, w)
    return beams


def is_sweep_lost(seed: int, sweep: int, sweep_loss: float) -> bool:
    """Return True if the sensor of a flight with this seed loses a sweep as a whole."""
    if sweep_loss == 0.0:
        return False
    return np.random.default_rng([seed & 0x7FFFFFFF, sweep % 2**32, _LOSS]).random() < sweep_loss


def _step(turns: float) -> int:
    """Return a step in units of 2^-32 turns.

    It is a multiple of the number of beams, so that the count of shots continues past an overflow.
    """
    return round(turns * 2**32 / _BEAMS) * _BEAMS % 2**32


class Lidar:
    """B equal sensors in B flights.

    Args:
        model: model of the sensors.
        worlds: worlds of the flights.
        seeds: one per flight. Pattern and noise of a sensor depend on its seed and the number of rays only, not on the
            batch.

    Attributes:
        points: sweep in progress [m], vec3 [B, points_per_sweep], placed in the world frame by the estimated pose at
            the time of each point; NaN where there is no return.
    """

    def __init__(self, model: LidarModel, worlds: DeviceWorlds, *, seeds: Sequence[int]) -> None:
        self.model = model
        self._worlds = worlds
        self._beams = pack_beams(model)
        with wp.ScopedDevice(worlds.device):
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds], dtype=int)
            self._lost = wp.zeros(len(seeds), dtype=int)
            self.points = wp.full((len(seeds), model.points_per_sweep), wp.vec3(math.nan), dtype=wp.vec3)
        self._host_seeds = [seed & 0x7FFFFFFF for seed in seeds]
        self._losing = False
        """True if a sensor may have lost the sweep in progress."""

    def use(self, model: LidarModel, worlds: DeviceWorlds) -> None:
        """Use another model, with as many points per sweep, and other worlds from now on."""
        self.model, self._worlds, self._beams = model, worlds, pack_beams(model)

    def loses(self, sweep: int) -> NDArray[np.bool_]:
        """Return which sensors lose a sweep as a whole, [B]."""
        return np.array([is_sweep_lost(seed, sweep, self.model.sweep_loss) for seed in self._host_seeds])

    def scan(
        self,
        sweep: int,
        first: int,
        end: int,
        *,
        poses: tuple[wp.array, wp.array],
        poses_before: tuple[wp.array, wp.array],
        finished: wp.array,
        estimated_poses: tuple[wp.array, wp.array] | None = None,
        estimated_poses_before: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Measure the points first .. end - 1 of a sweep into `points`. Sweep 0 begins at time 0 of the worlds.

        Args:
            sweep: number of the sweep; negative before time 0.
            first: first point.
            end: one past the last point.
            poses: true positions [m], vec3 [B], and quaternions w, x, y, z, vec4 [B], at the end of the scan, world
                frame.
            poses_before: true poses at the beginning; the sensor moves evenly in between.
            finished: int [B]; sensors with a value other than 0 measure nothing, and their points stay.
            estimated_poses, estimated_poses_before: poses that place the points in the world; None for the true ones.
        """
        worlds = self._worlds
        if self.model.sweep_loss > 0.0 or self._losing:
            self._losing = self.model.sweep_loss > 0.0
            self._lost.assign(self.loses(sweep).astype(np.int32))
        positions, quaternions = zip(poses_before, poses, strict=True)
        estimates = zip(estimated_poses_before or poses_before, estimated_poses or poses, strict=True)
        estimated_positions, estimated_quaternions = estimates
        inputs = [worlds.geometry, worlds.index, self._beams, self._seeds, sweep, first, end - first, finished]
        inputs.append(self._lost)
        inputs += [*positions, *quaternions, *estimated_positions, *estimated_quaternions]
        size = (len(self._seeds), end - first)
        wp.launch(scan(worlds.has_triangles), size, inputs=inputs, outputs=[self.points], device=worlds.device)
