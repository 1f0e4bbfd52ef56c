"""The simulated sensor with motion within a sweep, noise and dropout."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_from_angles
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.lidar_kernels import Beams, Poses, scan
from aero_viz.sensors.models import LidarModel

# The Mid-360, after the scan table that its maker publishes for simulation (livox_laser_simulation, mid360.csv).
_BEAMS = 4
_TURN_RATE = 176.4  # [Hz]
_SWING_RATE = 10.016  # [Hz]
_LOSS = 0x4C6F7373  # separates the random numbers of lost sweeps from others
_TILT = 3.6  # tilt of the rings of the outer beams [deg]


def pack_beams(model: LidarModel, *, first: LidarModel | None = None, salt: int = 0) -> Any:
    """Return the `Beams` of a model on a drone whose first sensor is `first`; None for the same model."""
    first = first or model
    beams: Any = Beams()
    beams.rays, beams.sweep_rate, beams.salt = first.rays_of(model), first.sweep_rate, salt
    beams.elevation_min = math.radians(model.elevation_min)
    beams.elevation_max = math.radians(model.elevation_max)
    beams.height_min, beams.height_max = math.sin(beams.elevation_min), math.sin(beams.elevation_max)
    for name in ("points_per_sweep", "range_min", "range_max", "range_noise", "dropout", "strays", "stray_range"):
        setattr(beams, name, getattr(model, name))
    width = model.azimuth_max - model.azimuth_min
    is_turn = width >= 360.0 or model.pattern == "livox"
    beams.azimuth_start = 0.0 if is_turn else math.radians(model.azimuth_min)
    beams.azimuth_width = math.radians(360.0 if is_turn else width)
    edges = (model.azimuth_min, model.azimuth_max) if is_turn and width < 360.0 else (-360.0, 360.0)
    beams.masked_below, beams.masked_above = map(math.radians, edges)
    if model.pattern == "rings":
        beams.rings = model.rings
    if model.pattern == "pinhole":
        beams.image_rows = model.rings
    if model.pattern == "livox":
        beams.tilt = min(math.radians(_TILT), 0.25 * (beams.elevation_max - beams.elevation_min))
    shots = model.points_per_sweep * model.sweep_rate / _BEAMS
    beams.turn_step, beams.swing_step = (wp.uint32(_step(rate / shots)) for rate in (_TURN_RATE, _SWING_RATE))
    beams.mount_position = wp.vec3(*model.mount_position)
    w, x, y, z = quaternion_from_angles(*model.mount_angles)
    beams.mount_attitude = wp.quat(x, y, z, w)
    return beams


def _pack_sensors(model: LidarModel) -> list[Any]:
    return [pack_beams(sensor, first=model, salt=7919 * i) for i, sensor in enumerate(model.sensors)]


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
    """B equal sensors in B flights, or B equal sets of sensors.

    Args:
        model: model of the sensors.
        worlds: worlds of the flights.
        seeds: one per flight. Pattern and noise of a sensor depend on its seed and the number of rays only, not on the
            batch.

    Attributes:
        points: sweep in progress [m], vec3 [B, rays_per_sweep], placed in the world frame by the estimated pose at
            the time of each point; NaN where there is no return.
    """

    def __init__(self, model: LidarModel, worlds: DeviceWorlds, *, seeds: Sequence[int]) -> None:
        self.model = model
        self._worlds = worlds
        self._beams = _pack_sensors(model)
        with wp.ScopedDevice(worlds.device):
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds], dtype=int)
            self._lost = wp.zeros(len(seeds), dtype=int)
            self.points = wp.full((len(seeds), model.rays_per_sweep), wp.vec3(math.nan), dtype=wp.vec3)
        self._host_seeds = [seed & 0x7FFFFFFF for seed in seeds]
        self._losing = False
        """True if a sensor may have lost the sweep in progress."""

    def use(self, model: LidarModel, worlds: DeviceWorlds) -> None:
        """Use another model, with as many points per sweep, and other worlds from now on."""
        self.model, self._worlds, self._beams = model, worlds, _pack_sensors(model)

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
        active: wp.array,
        estimated_poses: tuple[wp.array, wp.array] | None = None,
        estimated_poses_before: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Measure the points first .. end - 1 of a sweep into `points`. Sweep 0 begins at time 0 of the worlds.

        Every sensor has its share of these points, one after the other.

        Args:
            sweep: number of the sweep; negative before time 0.
            first: first point.
            end: one past the last point.
            poses: true positions [m], vec3 [B], and quaternions w, x, y, z, vec4 [B], at the end of the scan, world
                frame.
            poses_before: true poses at the beginning; the sensor moves evenly in between.
            active: mask, int [B]; sensors with 0 measure nothing, and their points stay.
            estimated_poses, estimated_poses_before: poses that place the points in the world; None for the true ones.
        """
        worlds = self._worlds
        if self.model.sweep_loss > 0.0 or self._losing:
            self._losing = self.model.sweep_loss > 0.0
            self._lost.assign(self.loses(sweep).astype(np.int32))
        moves = [_pack_poses(poses_before, poses)]
        moves.append(_pack_poses(estimated_poses_before or poses_before, estimated_poses or poses))
        offset = first
        for beams, before, after in zip(self._beams, self._shares(first), self._shares(end), strict=True):
            start = (math.floor(sweep * beams.rays) + 2**31) % 2**32 - 2**31
            inputs = [worlds.geometry, worlds.index, beams, self._seeds, sweep, start, before, after - before, offset]
            size = (len(self._seeds), after - before)
            inputs += [active, self._lost, *moves]
            wp.launch(scan(worlds.has_triangles), size, inputs=inputs, outputs=[self.points], device=worlds.device)
            offset += after - before

    def _shares(self, count: int) -> list[int]:
        """Return how many of the first `count` rays of a sweep belong to each sensor."""
        total, model = self.model.rays_per_sweep, self.model
        others = [count * math.floor(model.rays_of(sensor)) // total for sensor in model.others]
        return [count - sum(others), *others]


def _pack_poses(before: tuple[wp.array, wp.array], after: tuple[wp.array, wp.array]) -> Any:
    """Return the `Poses` of positions and quaternions."""
    poses: Any = Poses()
    poses.position_before, poses.quaternion_before = before
    poses.position, poses.quaternion = after
    return poses
