"""LiDAR models and the simulated sensor: rays over time, motion within a sweep, noise, misses."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.config.parameter import ParameterSection, choice, live, structural
from aero_viz.errors import UserError
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.scenes.geometry import Geometry
from aero_viz.sensors.raycast import ray_range

__all__ = ["LIDARS", "Lidar", "LidarModel", "full_sphere", "lidar_model", "livox_mid360", "spinning64"]

wp.set_module_options({"enable_backward": False})

# Steps of the two-dimensional low-discrepancy sequence R2 (Roberts 2018), 1 / rho and 1 / rho^2 with rho the plastic
# number, in units of 2^-32: integer overflow is the fractional part, exact for every index.
STEP_AZIMUTH = wp.constant(wp.uint32(3242174889))
STEP_ELEVATION = wp.constant(wp.uint32(2447445414))
INVERSE_2_24 = wp.constant(2.0**-24)

# The Mid-360, after the scan table that its maker publishes for simulation (livox_laser_simulation, mid360.csv).
_BEAMS = 4
_TURNS = 176.4  # [Hz]
_SWINGS = 10.016  # [Hz]
_TILT = 3.6  # of the outer beams' rings [deg]


@dataclass(frozen=True)
class LidarModel(ParameterSection, section="lidar"):
    """A LiDAR fixed to the body; sensor frame = body frame unless it is mounted otherwise.

    The patterns, of which the first two never repeat, so that gaps close the longer one looks (see `coverage`):

    - "livox": as a Mid-360 draws it. Four beams fire in turn; together they turn 176.4 times a second, each on a ring
      that is tilted a little differently, and the rings move over the field of view and back 10.016 times a second:
      e = m + s cos(2 pi 10.016 t) + w_i cos(2 pi 176.4 t), with m the middle of the field of view, w_i = 3.6, 1.2, -1.2
      and -3.6 deg, and s what is left to its edges.
    - "even": a low-discrepancy sequence that covers the field of view evenly per solid angle.
    - "rings": `rings` beams, evenly spaced in elevation, turn once per sweep.

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one.
    """

    name: str
    elevation_min: float = live(-7.0, "deg", -90.0, 90.0, "Lower edge of the field of view; it looks 360 deg around.")
    elevation_max: float = live(52.0, "deg", -90.0, 90.0, "Upper edge of the field of view.")
    points_per_sweep: int = structural(20_000, 1, 1_000_000, "Rays of a sweep.")
    sweep_rate: float = live(10.0, "Hz", 0.1, 1000.0, "Sweeps per second.")
    range_min: float = live(0.1, "m", 0.0, 100.0, "Nearer surfaces give no point.")
    range_max: float = live(40.0, "m", 0.1, 1000.0, "Farther surfaces give no point.")
    range_noise: float = live(0.02, "m", 0.0, 10.0, "Standard deviation of the range.")
    dropout: float = live(0.02, "", 0.0, 1.0, "Fraction of the returns that are lost.")
    pattern: str = choice("even", ("livox", "even", "rings"), "Where the rays go.")
    rings: int = structural(64, 1, 1024, "Beams of the pattern of rings, evenly spaced in elevation.")
    mount_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the sensor, body frame [m]."""
    mount_angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw, sensor to body, R = R_z(yaw) R_y(pitch) R_x(roll) [deg]; (180, 0, 0) looks downward."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (("elevation_min", "elevation_max"), ("range_min", "range_max")):
            least, most = getattr(self, low), getattr(self, high)
            if least >= most:
                raise ValueError(f"lidar.{low} is {least:g}; it must be less than lidar.{high}, which is {most:g}.")
        if self.pattern == "rings" and self.points_per_sweep % self.rings:
            raise ValueError(f"lidar.rings is {self.rings}; it must divide lidar.points_per_sweep, which is "
                             f"{self.points_per_sweep}.")  # fmt: skip
        for name in ("mount_position", "mount_angles"):
            value = getattr(self, name)
            if len(value) != 3 or not all(map(math.isfinite, value)):
                raise ValueError(f"lidar.{name} is {value!r}; it must be three finite numbers.")

    def point_times(self) -> NDArray[Any]:
        """Return when each point of a sweep is measured, from the start of the sweep [s], shape [points_per_sweep]."""
        return (np.arange(self.points_per_sweep) + 0.5) / (self.points_per_sweep * self.sweep_rate)


def livox_mid360() -> LidarModel:
    """Return the Livox Mid-360: 200 000 points/s, non-repetitive, -7 to 52 degrees."""
    return LidarModel("mid360", pattern="livox")


def full_sphere() -> LidarModel:
    """Return a sensor that sees all around, at the Mid-360's rate: what a planner could do without blind zones."""
    return LidarModel("full-sphere", elevation_min=-90.0, elevation_max=90.0)


def spinning64() -> LidarModel:
    """Return a spinning sensor with 64 rings of 512 points, -22.5 to 22.5 degrees, 10 Hz."""
    return LidarModel(
        "spinning64", elevation_min=-22.5, elevation_max=22.5, points_per_sweep=64 * 512, range_max=90.0,
        pattern="rings",
    )  # fmt: skip


LIDARS: dict[str, Callable[[], LidarModel]] = {
    "mid360": livox_mid360,
    "full-sphere": full_sphere,
    "spinning64": spinning64,
}


def lidar_model(name: str) -> LidarModel:
    """Return a model by name.

    Raises:
        UserError: no such model; the message lists them.
    """
    if name not in LIDARS:
        close = difflib.get_close_matches(name, LIDARS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise UserError(f"Unknown LiDAR {name!r}.{hint} LiDARs: {', '.join(LIDARS)}.")
    return LIDARS[name]()


@wp.struct
class Beams:
    """`LidarModel` for kernels."""

    elevation_min: float
    """[rad]"""
    elevation_max: float
    height_min: float
    """Sine of elevation_min; even steps of it are even steps of solid angle."""
    height_max: float
    points_per_sweep: int
    range_min: float
    range_max: float
    range_noise: float
    dropout: float
    rings: int
    """0 for another pattern."""
    tilt: float
    """Of the outer beams' rings of a Livox [rad], 0 for another pattern."""
    turn_step: wp.uint32
    """What a Livox turns from one shot of its four beams to the next, in units of 2^-32 turns."""
    swing_step: wp.uint32
    """The same of its way over the field of view and back."""
    mount_position: wp.vec3
    mount_attitude: wp.quat
    """Sensor to body."""


def pack_beams(model: LidarModel) -> Any:
    """Return the `Beams` of a model."""
    beams: Any = Beams()
    beams.elevation_min = math.radians(model.elevation_min)
    beams.elevation_max = math.radians(model.elevation_max)
    beams.height_min, beams.height_max = math.sin(beams.elevation_min), math.sin(beams.elevation_max)
    for name in ("points_per_sweep", "range_min", "range_max", "range_noise", "dropout"):
        setattr(beams, name, getattr(model, name))
    if model.pattern == "rings":
        beams.rings = model.rings
    if model.pattern == "livox":
        beams.tilt = min(math.radians(_TILT), 0.25 * (beams.elevation_max - beams.elevation_min))
    shots = model.points_per_sweep * model.sweep_rate / _BEAMS
    beams.turn_step, beams.swing_step = (wp.uint32(_step(rate / shots)) for rate in (_TURNS, _SWINGS))
    beams.mount_position = wp.vec3(*model.mount_position)
    half = [0.5 * math.radians(angle) for angle in model.mount_angles]
    (cr, cp, cy), (sr, sp, sy) = [math.cos(a) for a in half], [math.sin(a) for a in half]
    beams.mount_attitude = wp.quat(
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    return beams


def _step(turns: float) -> int:
    """Return a step in units of 2^-32 turns; a multiple of the beams, so that shots, too, count on past an overflow."""
    return round(turns * 2**32 / _BEAMS) * _BEAMS % 2**32


@wp.func
def fraction(index: wp.uint32, step: wp.uint32):
    """Fractional part of index * step / 2^32."""
    return float((index * step) >> wp.uint32(8)) * INVERSE_2_24


@wp.func
def beam_direction(beams: Beams, index: int, phase: wp.uint32):
    """Unit direction in the sensor frame of the ray `index`, counted through all sweeps."""
    azimuth = float(0.0)
    height = float(0.0)
    if beams.rings > 0:
        i = (index % beams.points_per_sweep + beams.points_per_sweep) % beams.points_per_sweep
        ring = i % beams.rings
        azimuth = float(i - ring) / float(beams.points_per_sweep)
        share = float(ring) / float(wp.max(beams.rings - 1, 1))
        height = wp.sin(beams.elevation_min + share * (beams.elevation_max - beams.elevation_min))
    elif beams.tilt > 0.0:
        k = wp.uint32(index) + phase
        shot = k / wp.uint32(4)
        weight = 1.0 - float(k % wp.uint32(4)) / 1.5
        azimuth = fraction(shot, beams.turn_step)
        middle = 0.5 * (beams.elevation_min + beams.elevation_max)
        reach = beams.elevation_max - middle - beams.tilt
        swing = reach * wp.cos(2.0 * wp.pi * fraction(shot, beams.swing_step))
        height = wp.sin(middle + swing + weight * beams.tilt * wp.cos(2.0 * wp.pi * azimuth))
    else:
        k = wp.uint32(index) + phase
        azimuth = fraction(k, STEP_AZIMUTH)
        height = beams.height_min + fraction(k, STEP_ELEVATION) * (beams.height_max - beams.height_min)
    flat = wp.sqrt(wp.max(1.0 - height * height, 0.0))
    angle = 2.0 * wp.pi * azimuth
    return wp.vec3(flat * wp.cos(angle), flat * wp.sin(angle), height)


@wp.func
def attitude_between(before: wp.vec4, after: wp.vec4, share: float):
    """Attitude between two that differ little, as Warp's x, y, z, w."""
    sign = wp.where(wp.dot(before, after) < 0.0, -1.0, 1.0)
    q = wp.normalize((1.0 - share) * before + (share * sign) * after)
    return wp.quat(q[1], q[2], q[3], q[0])


@wp.kernel
def scan_kernel(
    geometry: Geometry,
    world: wp.array(dtype=int),
    beams: Beams,
    seeds: wp.array(dtype=int),
    finished: wp.array(dtype=int),
    position_before: wp.array(dtype=wp.vec3),
    position: wp.array(dtype=wp.vec3),
    quaternion_before: wp.array(dtype=wp.vec4),
    quaternion: wp.array(dtype=wp.vec4),
    believed_position_before: wp.array(dtype=wp.vec3),
    believed_position: wp.array(dtype=wp.vec3),
    believed_quaternion_before: wp.array(dtype=wp.vec4),
    believed_quaternion: wp.array(dtype=wp.vec4),
    sweep: int,
    first: int,
    count: int,
    points: wp.array2d(dtype=wp.vec3),
):
    b, i = wp.tid()
    if finished[b] != 0:
        return
    index = sweep * beams.points_per_sweep + first + i
    share = (float(i) + 0.5) / float(count)
    beam = wp.quat_rotate(beams.mount_attitude, beam_direction(beams, index, wp.rand_init(seeds[b])))
    attitude = attitude_between(quaternion_before[b], quaternion[b], share)
    origin = wp.lerp(position_before[b], position[b], share) + wp.quat_rotate(attitude, beams.mount_position)
    direction = wp.quat_rotate(attitude, beam)
    distance = ray_range(geometry, world[b], origin, direction, beams.range_max)
    point = wp.vec3(wp.nan, wp.nan, wp.nan)
    if distance <= beams.range_max and distance >= beams.range_min:
        random = wp.rand_init(seeds[b], index)
        if wp.randf(random) >= beams.dropout:
            in_body = beams.mount_position + (distance + beams.range_noise * wp.randn(random)) * beam
            believed = attitude_between(believed_quaternion_before[b], believed_quaternion[b], share)
            place = wp.lerp(believed_position_before[b], believed_position[b], share)
            point = place + wp.quat_rotate(believed, in_body)
    points[b, first + i] = point


class Lidar:
    """B equal sensors in B flights.

    Args:
        model: of the sensors.
        worlds: the worlds of B flights.
        seeds: one per flight; the seed and the count of rays fix a sensor's pattern and noise, whatever the batch.

    Attributes:
        points: the sweep in progress [m], vec3 [B, points_per_sweep], world frame by the believed pose at each
            point's time; NaN is no return.
    """

    def __init__(self, model: LidarModel, worlds: DeviceWorlds, *, seeds: Sequence[int]) -> None:
        self.model = model
        self._worlds = worlds
        self._beams = pack_beams(model)
        with wp.ScopedDevice(worlds.device):
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds], dtype=int)
            self.points = wp.full((len(seeds), model.points_per_sweep), wp.vec3(math.nan), dtype=wp.vec3)

    def scan(
        self,
        sweep: int,
        first: int,
        end: int,
        *,
        poses: tuple[wp.array, wp.array],
        poses_before: tuple[wp.array, wp.array],
        finished: wp.array,
        believed: tuple[wp.array, wp.array] | None = None,
        believed_before: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Measure the points first .. end - 1 of a sweep into `points`.

        Args:
            sweep: number of the sweep; negative before time 0.
            first: first point.
            end: one past the last point.
            poses: positions [m], vec3 [B], and quaternions w, x, y, z, vec4 [B], at the end of the scan, world frame.
            poses_before: at its beginning; the sensor moves evenly in between.
            finished: int [B]; sensors with anything but 0 measure nothing, their points stay.
            believed, believed_before: the estimated poses that place the points in the world; None for the true ones.
        """
        worlds = self._worlds
        positions, quaternions = zip(poses_before, poses, strict=True)
        places, attitudes = zip(believed_before or poses_before, believed or poses, strict=True)
        inputs = [worlds.geometry, worlds.index, self._beams, self._seeds, finished]
        inputs += [*positions, *quaternions, *places, *attitudes]
        inputs += [sweep, first, end - first]
        wp.launch(scan_kernel, (len(self._seeds), end - first), inputs, [self.points], device=worlds.device)
