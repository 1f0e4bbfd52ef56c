"""Sweeps of a simulated Mid-360 on a drone that stands in the air, for tests of what the node sees in its clouds."""

from collections.abc import Iterable

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_from_angles
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.lidar import Lidar
from aero_viz.sensors.models import LIDARS


def scan(
    world: World, place: NDArray[np.float64], errors: Iterable[tuple[float, float, float, float]], *, first: int = 0
) -> list[NDArray[np.float32]]:
    """Return one sweep per error of the estimate, in x, y [m], roll and pitch [deg]; the drone is level at `place`.

    The sweeps have the numbers `first` and up, and sweep 0 begins at time 0 of the world.
    """
    model = LIDARS["mid360"]
    lidar = Lidar(model, DeviceWorlds([world], device="cpu"), seeds=[0])
    pose, active, sweeps = _pose(place, 0.0, 0.0), wp.ones(1, dtype=int, device="cpu"), []
    for k, (x, y, roll, pitch) in enumerate(errors, first):
        estimated = _pose(place + np.array([x, y, 0.0]), roll, pitch)
        lidar.scan(k, 0, model.points_per_sweep, poses=pose, poses_before=pose, active=active,
                   estimated_poses=estimated, estimated_poses_before=estimated)  # fmt: skip
        points = lidar.points.numpy()[0]
        sweeps.append(points[np.isfinite(points).all(axis=1)].copy())
    return sweeps


def _pose(position: NDArray[np.float64], roll: float, pitch: float) -> tuple[wp.array, wp.array]:
    quaternion = tuple(quaternion_from_angles(roll, pitch, 0.0))
    return (
        wp.array([tuple(position)], dtype=wp.vec3, device="cpu"),
        wp.array([quaternion], dtype=wp.vec4, device="cpu"),
    )
