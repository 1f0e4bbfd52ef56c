"""A simulated cloud of a Livox Mid-360 in a forest, for benchmarks and the preflight check.

The rays are cast in NumPy. The cloud is realistic where random points are not: half of the rays have no return, and
their points are NaN; most of the others hit nearby trunks; the ground is seen only at some distance, because the sensor
does not look down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_planner.plan import Goal, VehicleState

_SWEEPS = 10
_SWEEP_PERIOD = 0.1  # [s]
_SPEED = 4.0  # of the drone, along x [m/s]
_PITCH = np.radians(10.0)  # nose down, as in forward flight
_ELEVATION_MIN, _ELEVATION_MAX = np.radians(-7.0), np.radians(52.0)  # field of view of a Mid-360
_RANGE_MAX = 40.0  # [m]
_RANGE_NOISE = 0.02  # standard deviation [m]
_TREES = 120
_TREE_HEIGHT = 8.0  # [m]


def forest_cloud(count: int, *, seed: int = 0) -> NDArray[np.float32]:
    """Return ten sweeps of a Mid-360 that flies through a forest at 4 m/s and is now at (0, 0, 2).

    Args:
        count: number of rays, P.
        seed: seed of the trees, the rays and the range noise.

    Returns:
        Points [m], shape [P, 3], world frame; NaN for rays without return.
    """
    rng = np.random.default_rng(seed)
    distance, angle = rng.uniform(1.5, 30.0, _TREES), rng.uniform(-np.pi, np.pi, _TREES)
    trees = np.stack((distance * np.cos(angle), distance * np.sin(angle), rng.uniform(0.1, 0.4, _TREES)), axis=1)
    # A tree in the drone's path would surround the sensor.
    blocking = (np.abs(trees[:, 1]) < 0.8) & (trees[:, 0] < 0.8)
    trees[blocking, 1] += 2.0
    sweeps = np.array_split(np.arange(count), _SWEEPS)
    clouds = [
        _sweep(len(rays), -_SPEED * _SWEEP_PERIOD * (_SWEEPS - 1 - i), trees, rng) for i, rays in enumerate(sweeps)
    ]
    return np.concatenate(clouds).astype(np.float32)


def forest_flight(
    points: int, batch: int | None = None, *, seed: int = 0
) -> tuple[VehicleState, Goal, NDArray[np.float32] | list[NDArray[np.float32]]]:
    """Return state, goal and cloud of a drone at 4 m/s in that forest; with a batch, B copies of each.

    Args:
        points, seed: as for `forest_cloud`.
        batch: number of drones, B; None for arrays without a batch axis.
    """
    values = ((0.0, 0.0, 2.0), (_SPEED, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (30.0, 0.0, 2.0))
    position, velocity, quaternion, goal = (
        np.array(value) if batch is None else np.tile(value, (batch, 1)) for value in values
    )
    cloud = forest_cloud(points, seed=seed)
    return VehicleState(position, velocity, quaternion), Goal(goal), cloud if batch is None else [cloud] * batch


def _sweep(count: int, x: float, trees: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the points of `count` random rays from (x, 0, 2), shape [count, 3]; NaN without return.

    `trees` are vertical cylinders on the ground: x, y, radius [m], shape [T, 3].
    """
    azimuth = rng.uniform(-np.pi, np.pi, count)
    elevation = rng.uniform(_ELEVATION_MIN, _ELEVATION_MAX, count)
    forward, left, up = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    c, s = np.cos(_PITCH), np.sin(_PITCH)
    rays = np.stack((c * forward + s * up, left, c * up - s * forward), axis=1)
    origin = np.array([x, 0.0, 2.0])
    down = rays[:, 2] < 0.0
    ranges = np.full(count, np.inf)
    ranges[down] = -origin[2] / rays[down, 2]
    planar = rays[:, :2]
    a = np.sum(planar**2, axis=1)
    for tree_x, tree_y, radius in trees:
        # |o + t d|^2 = r^2 in the plane; the smaller root is the near side.
        offset = origin[:2] - (tree_x, tree_y)
        b = planar @ offset
        discriminant = b * b - a * (offset @ offset - radius**2)
        hit = (discriminant > 0.0) & (b < 0.0)
        t = (-b[hit] - np.sqrt(discriminant[hit])) / a[hit]
        height = origin[2] + t * rays[hit, 2]
        ranges[hit] = np.where((height > 0.0) & (height < _TREE_HEIGHT), np.minimum(ranges[hit], t), ranges[hit])
    ranges[ranges > _RANGE_MAX] = np.nan
    ranges += rng.normal(0.0, _RANGE_NOISE, count)
    return origin + ranges[:, None] * rays
