"""Poses of the GPS and IMU of KITTI's raw data, in the folder oxts next to velodyne_points."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_from_angles, quaternion_of_matrix
from aero_planner.user_file import read_user_text
from aero_viz.errors import UserError
from aero_viz.recordings.cloud_times import read_stamps
from aero_viz.recordings.transforms import Transform

_EARTH_RADIUS = 6_378_137.0
_COLUMNS = 11
"""Latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad], velocities north, east, forward, left, up [m/s]."""
_LINE_MAX = 4096  # [bytes]


class OxtsTable(NamedTuple):
    """Motion of the IMU, whose axes point forward, left and up."""

    times: NDArray[np.float64]
    """[n] [s] since 1970."""
    positions: NDArray[np.float64]
    """[n, 3] [m] east, north, up; on the Mercator map that KITTI's own tools use."""
    quaternions: NDArray[np.float64]
    """[n, 4] w, x, y, z."""
    twists: NDArray[np.float64]
    """[n, 3] [m/s], frame of the IMU."""


def read_oxts(folder: Path) -> OxtsTable:
    """Return the motion in a folder oxts.

    Raises:
        UserError: a file is damaged, or the times do not fit the files.
    """
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        raise UserError(f"{folder}/data holds no .txt: copy KITTI's oxts again.")
    rows = np.stack([_read_row(file) for file in files])
    times = 1e-9 * np.array(read_stamps(folder / "timestamps.txt", files), np.float64)
    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale = np.cos(latitude[0]) * _EARTH_RADIUS
    north = np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    positions = np.stack([scale * longitude, scale * north, rows[:, 2]], axis=1)
    quaternions = np.stack([quaternion_from_angles(*angles) for angles in np.degrees(rows[:, 3:6]).tolist()])
    return OxtsTable(times, positions, quaternions, rows[:, 8:11])


def oxts_mount(folder: Path) -> tuple[Path, Transform] | None:
    """Return KITTI's calibration near a folder oxts, and the pose of the LiDAR in the frame of the IMU, if it exists.

    Raises:
        UserError: the calibration is damaged.
    """
    for path in (place / "calib_imu_to_velo.txt" for place in folder.resolve().parents[:2]):
        try:
            lines = read_user_text(path, limit=_LINE_MAX).splitlines()
            entries = {name: numbers.split() for name, _, numbers in (line.partition(":") for line in lines)}
            rotation = np.array(entries["R"], np.float64).reshape(3, 3)
            position = -rotation.T @ np.array(entries["T"], np.float64).reshape(3)
        except FileNotFoundError:
            continue
        except (OSError, ValueError, KeyError):
            rotation, position = np.zeros((3, 3)), np.zeros(3)
        if not (abs(np.linalg.det(rotation) - 1.0) < 0.1 and np.isfinite(position).all()):
            raise UserError(f"{path} holds no rotation R and translation T: copy it again, or remove it.")
        return path, Transform(position, quaternion_of_matrix(rotation.T))
    return None


def _read_row(path: Path) -> NDArray[np.float64]:
    try:
        row = np.array(read_user_text(path, limit=_LINE_MAX).split()[:_COLUMNS], np.float64)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError:
        row = np.zeros(0)
    if len(row) < _COLUMNS or not np.isfinite(row).all() or abs(row[0]) > 89.0 or np.abs(row).max() > 1e6:
        raise UserError(f"{path} is not a row of KITTI's oxts (latitude, longitude, altitude, ..): copy it again.")
    return row
