"""Poses from files next to a recording: TUM and KITTI text, and the state in a ULog of PX4."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import multiply, quaternion_of_matrix, rotate, rotation_matrix
from aero_planner.user_file import open_user_file, read_user_text
from aero_viz.errors import UserError
from aero_viz.reader_process import Limits, ReaderProcess
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.other_formats import is_oxts
from aero_viz.recordings.oxts import oxts_mount, read_oxts
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.transforms import IDENTITY

if TYPE_CHECKING:
    from aero_viz.recordings.recording import Recording

T = TypeVar("T")

ULOG_MAGIC = b"ULog\x01\x12\x35"
_LINE_MAX = 4096  # [bytes]
_NUMBERS_MAX = 1 << 26
_LARGEST = 1e19
"""Largest number in a table of poses, which is a time since 1970 [ns]."""
_SQRT_HALF = float(np.sqrt(0.5))
_NED_TO_ENU = np.array([0.0, _SQRT_HALF, _SQRT_HALF, 0.0])
_FLU_TO_FRD = np.array([0.0, 1.0, 0.0, 0.0])


class PoseTable(NamedTuple):
    """The poses in a file."""

    format: str
    """"TUM", "KITTI", "KITTI's oxts" or "ULog"."""
    times: NDArray[np.float64] | None
    """[n] [s] on the file's own clock; None for KITTI, which has one pose per sweep."""
    positions: NDArray[np.float64]
    """[n, 3] [m], world z up."""
    quaternions: NDArray[np.float64]
    """[n, 4] w, x, y, z."""
    twists: NDArray[np.float64] | None
    """Velocities in the body frame [n, 3] [m/s]."""
    utc: float | None = None
    """Time since 1970 at time 0 of the file's clock [s], None where it is not known."""


def read_pose_file(path: Path) -> PoseTable:
    """Return the poses in a file, whose content decides its format, or in a folder oxts of KITTI's raw data.

    TUM: lines of time x y z qx qy qz qw. KITTI: lines of the 12 numbers of a 3 x 4 matrix.

    Raises:
        UserError: the file cannot be read or is of another format.
    """
    if is_oxts(path):
        return PoseTable("KITTI's oxts", *read_oxts(path))
    try:
        with open_user_file(path) as file:
            is_ulog = file.read(len(ULOG_MAGIC)) == ULOG_MAGIC
            file.seek(0)
            table = np.zeros((0, 0)) if is_ulog else _read_table(path, file)
    except OSError as error:
        raise UserError(f"Cannot read the poses {path}: {error.strerror or error}.") from error
    if is_ulog:
        return read_in_process(_read_ulog, path)
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        raise UserError(f"{path} holds numbers that are not finite: see pose {int(np.argmin(finite)) + 1}.")
    if np.abs(table).max() > _LARGEST:
        raise UserError(f"{path} holds impossible numbers: see pose {int(np.abs(table).max(axis=1).argmax()) + 1}.")
    if table.shape[1] == 12:
        matrices = table.reshape(-1, 3, 4)
        rotation = matrices[:, :, :3]
        if np.abs(np.linalg.det(rotation) - 1.0).max() > 0.1:
            raise UserError(f"{path} is not KITTI text: its matrices are not rotations.")
        return PoseTable("KITTI", None, matrices[:, :, 3], quaternion_of_matrix(rotation), None)
    quaternions = table[:, [7, 4, 5, 6]]
    norms = np.linalg.norm(quaternions, axis=1)
    if (np.abs(norms - 1.0) > 0.1).any():
        line = int(np.flatnonzero(np.abs(norms - 1.0) > 0.1)[0]) + 1
        raise UserError(f"{path} is not TUM text: the quaternion of pose {line} has the length {norms[line - 1]:.2f}.")
    return PoseTable("TUM", table[:, 0], table[:, 1:4], quaternions / norms[:, None], None)


def _read_table(path: Path, file: BinaryIO) -> NDArray[np.float64]:
    """Return the numbers in the lines of a text [n, 8] or [n, 12]."""
    numbers, width = array("d"), 0
    while line := file.readline(_LINE_MAX):
        words = line.replace(b",", b" ").split()
        if not words or line.startswith(b"#"):
            continue
        width = width or len(words)
        if len(words) != width or width not in (8, 12):
            raise UserError(
                f"{path} holds no poses: every line must have 8 numbers (TUM: time x y z qx qy qz qw) or 12 (KITTI)."
            )
        try:
            numbers.extend(map(float, words))
        except ValueError as error:
            raise UserError(f"{path} holds something else than numbers: {one_line(error)}.") from error
        if len(numbers) > _NUMBERS_MAX:
            raise UserError(f"{path} holds more than {_NUMBERS_MAX // width} poses; cut it.")
    if not numbers:
        raise UserError(f"{path} holds no poses: give TUM or KITTI text, or a ULog of PX4.")
    return np.frombuffer(numbers, np.float64).reshape(-1, width)


def read_in_process(function: Callable[[Path], T], path: Path) -> T:
    """Return the result of a function that reads a file, called in a separate process: hostile logs take gigabytes.

    Raises:
        UserError: the file cannot be read within the limits; the text names it.
    """
    process = ReaderProcess(Limits.for_file(path.stat().st_size), is_kept=True)
    try:
        return process(function, path)
    except UserError as error:
        if str(path) in str(error):
            raise
        raise UserError(f"{path} cannot be read: {error}") from error
    finally:
        process.close()


def load_ulog(path: Path, topics: list[str]) -> Any:
    """Return a log of PX4 with the messages of some topics, as pyulog's ULog.

    Raises:
        UserError: it cannot be read, or pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise UserError(
            f"pyulog is not installed ({error}): pip install 'aero-viz[formats]' to read {path}."
        ) from error
    with _damage_reported(path):
        return ULog(str(path), topics)


def _read_ulog(path: Path) -> PoseTable:
    """Return position, attitude and velocity of a PX4 log, moved from NED and FRD to ENU and FLU."""
    log = load_ulog(path, ["vehicle_local_position", "vehicle_attitude", "vehicle_gps_position", "sensor_gps"])
    with _damage_reported(path):
        return _ulog_poses(path, {entry.name: entry.data for entry in reversed(log.data_list)})


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # the parser fails in many ways on damaged logs
        reason = f"a topic lacks the field {error}" if isinstance(error, KeyError) else one_line(error)
        raise UserError(f"{path} cannot be read and may be damaged or truncated: {reason}.") from error


def _ulog_poses(path: Path, data: dict[str, dict[str, NDArray[np.generic]]]) -> PoseTable:
    if "vehicle_local_position" not in data or "vehicle_attitude" not in data:
        raise UserError(f"{path} has no vehicle_local_position and vehicle_attitude: log the estimator's topics.")
    place, attitude = data["vehicle_local_position"], data["vehicle_attitude"]
    times = 1e-6 * place["timestamp"].astype(np.float64)
    ned = np.stack([place[name] for name in ("x", "y", "z")], axis=1).astype(np.float64)
    speed = np.stack([place[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float64)
    frd = np.stack([attitude[f"q[{i}]"] for i in range(4)], axis=1).astype(np.float64)
    at = 1e-6 * attitude["timestamp"].astype(np.float64)
    valid = np.isfinite(ned).all(axis=1) & np.isfinite(speed).all(axis=1) & (times >= at[0]) & (times <= at[-1])
    times, ned, speed = times[valid], ned[valid], speed[valid]
    if not len(times):
        raise UserError(f"{path} has no valid position: the estimator had none during this log.")
    nearest = np.clip(np.searchsorted(at, times), 0, len(at) - 1)
    quaternions = multiply(multiply(_NED_TO_ENU, frd[nearest]), _FLU_TO_FRD)
    positions, velocities = rotate(_NED_TO_ENU, ned), rotate(_NED_TO_ENU, speed)
    twists = rotate(quaternions * [1.0, -1.0, -1.0, -1.0], velocities)
    return PoseTable("ULog", times, positions, quaternions, twists, _utc(data))


def _utc(data: dict[str, dict[str, NDArray[np.generic]]]) -> float | None:
    for name in ("vehicle_gps_position", "sensor_gps"):
        gps = data.get(name, {})
        if "time_utc_usec" in gps:
            utc = gps["time_utc_usec"].astype(np.float64)
            known = utc > 0
            if known.any():
                return float(np.median(1e-6 * (utc[known] - gps["timestamp"][known].astype(np.float64))))
    return None


def add_poses(recording: Recording, path: Path) -> None:
    """Play a recording with the poses of a file.

    Times are those of the sweeps' stamps, or since the first sweep. A ULog, whose clock starts with the autopilot, is
    aligned by its GPS time; without it, its first pose is assigned to the first sweep.

    Raises:
        UserError: the file holds no poses, or none during the sweeps.
    """
    table = read_pose_file(path)
    sweeps = recording.sweep_times
    notices = [f"poses are those of {path.name} ({table.format})"]
    if table.times is None:
        if len(table.positions) != len(sweeps):
            raise UserError(
                f"{path} has {len(table.positions)} poses and {recording.path} {len(sweeps)} sweeps: KITTI text must "
                "have one pose per sweep; give TUM text, which has times."
            )
        times = sweeps
        if mount := _camera_mount(path, recording.path):
            name, camera = mount
            table = _move_to_sensor(table, camera)
            notices.append(f"{path.name} holds the poses of a camera: {name} moves them to the LiDAR")
    else:
        start, first = recording.start * 1e-9, table.times[0]
        candidates = [("", table.times - start), ("counted from the first sweep", table.times)]
        if table.utc is not None:
            candidates.insert(0, ("aligned by GPS time", table.times + table.utc - start))
        candidates.append(("the first pose is assumed to be that of the first sweep", table.times - first))
        choice, times = next((c for c in candidates if _overlaps(c[1], sweeps)), candidates[-1])
        notices += [f"the times of {path.name}: {choice}"] if choice else []
    if is_oxts(path) and recording.extrinsic is IDENTITY and (imu := oxts_mount(path)):
        recording.mount(imu[1])
        notices.append(f"{path.name} holds the poses of the IMU: {imu[0].name} places the LiDAR on it")
    poses = RecordedPoses(times, table.positions, table.quaternions, table.twists)
    covered = poses.covers(sweeps)
    if not covered.any():
        raise UserError(f"The poses of {path} do not overlap the sweeps of {recording.path} in time.")
    recording.keep(covered)
    recording.use_poses(poses.shifted(float(sweeps[covered][0])), path.name, notices, origin="file")


def _camera_mount(poses: Path, recording: Path) -> tuple[Path, NDArray[np.float64]] | None:
    """Return KITTI's calibration near the poses or the clouds, and the pose of the LiDAR in its camera [4, 4]."""
    for folder in dict.fromkeys((poses.parent, recording, recording.parent)):
        try:
            lines = read_user_text(folder / "calib.txt", limit=_LINE_MAX).splitlines()
        except (OSError, ValueError):
            continue
        for line in lines:
            name, _, numbers = line.partition(":")
            if name.strip() in ("Tr", "Tr_velo_to_cam") and len(numbers.split()) == 12:
                matrix = np.vstack([np.array(numbers.split(), np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
                if abs(np.linalg.det(matrix) - 1.0) < 0.1:
                    return folder / "calib.txt", matrix
    return None


def _move_to_sensor(table: PoseTable, mount: NDArray[np.float64]) -> PoseTable:
    """Return the poses of a sensor from those of a camera and the pose of the sensor in it [4, 4]."""
    poses = np.tile(np.eye(4), (len(table.positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation_matrix(table.quaternions), table.positions
    poses = np.linalg.inv(mount) @ poses @ mount
    return table._replace(positions=poses[:, :3, 3], quaternions=quaternion_of_matrix(poses[:, :3, :3]))


def _overlaps(times: NDArray[np.float64], sweeps: NDArray[np.float64]) -> bool:
    inside = (sweeps >= times.min()) & (sweeps <= times.max())
    return bool(inside.mean() > 0.5)
