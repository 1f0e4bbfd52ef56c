"""Poses from files next to a recording: TUM and KITTI text, and the state in a ULog of PX4."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import multiply, quaternion_of_matrix, rotate, rotation_matrix
from aero_planner.user_file import open_user_file, read_user_text
from aero_viz.errors import UserError
from aero_viz.extras import from_extra
from aero_viz.reader_process import Limits, ReaderProcess
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.cloud_folders import is_oxts
from aero_viz.recordings.cloud_times import FIRST_STAMP, SINCE_1970
from aero_viz.recordings.oxts import oxts_mount, read_oxts
from aero_viz.recordings.pose_tables import PoseTable, read_pose_text
from aero_viz.recordings.poses import POSE_TOLERANCE, RecordedPoses
from aero_viz.recordings.transforms import IDENTITY
from aero_viz.scenes.decoder_checks import refuse_pointer

if TYPE_CHECKING:
    from aero_viz.recordings.recording import Recording

T = TypeVar("T")

ULOG_MAGIC = b"ULog\x01\x12\x35"
_LINE_MAX = 4096  # [bytes]
_UNITS = {"": 1.0, "in milliseconds": 1e-3, "in microseconds": 1e-6, "in nanoseconds": 1e-9}
_MOUNT_MAX = 100.0
"""Largest distance of a LiDAR from the camera [m]."""
_STEP_MIN, _STEP_MAX = 5e-4, 5.0
"""Shortest and longest plausible time between two poses of a text [s]; others are in another unit."""
_SQRT_HALF = float(np.sqrt(0.5))
_NED_TO_ENU = np.array([0.0, _SQRT_HALF, _SQRT_HALF, 0.0])
_FLU_TO_FRD = np.array([0.0, 1.0, 0.0, 0.0])


def read_pose_file(path: Path) -> PoseTable:
    """Return the poses in a file, whose content decides its format, or in a folder oxts of KITTI's raw data.

    Raises:
        UserError: the file cannot be read or is of another format.
    """
    if is_oxts(path):
        return PoseTable("KITTI's oxts", *read_oxts(path), is_in_seconds=True)
    try:
        refuse_pointer(path)
        with open_user_file(path) as file:
            is_ulog = file.read(len(ULOG_MAGIC)) == ULOG_MAGIC
            file.seek(0)
            if not is_ulog:
                return read_pose_text(path, file)
    except OSError as error:
        raise UserError(f"Cannot read the poses {path}: {error.strerror or error}.") from error
    return read_in_process(_read_ulog, path)


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
    with from_extra("formats", f"{path} and other logs of PX4"):
        from pyulog import ULog
    with _damage_reported(path), open_user_file(path) as file:
        return ULog(file, topics)


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
        reason = "its records have impossible lengths" if isinstance(error, OSError) else reason
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
    return PoseTable("ULog", times, positions, quaternions, twists, _utc(data), is_in_seconds=True)


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

    Times are those of the sweeps' stamps where they overlap these, else since the first sweep; in s, ms, us or ns,
    whichever fits the sweeps. A ULog, whose clock starts with the autopilot, is aligned by its GPS time; without it,
    its first pose is assigned to the first sweep.

    Raises:
        UserError: the file holds no poses, or none during the sweeps.
    """
    table = read_pose_file(path)
    sweeps = recording.sweep_times
    notices = [f"poses are those of {path.name} ({table.format})", *([table.notice] if table.notice else [])]
    if table.times is None:
        table, notice = _poses_of_sweeps(table, path, recording)
        notices += [notice] if notice else []
        times = sweeps
        if mount := _camera_mount(path, recording.path):
            name, camera = mount
            table = _move_to_sensor(table, camera)
            notices.append(f"{path.name} holds the poses of a camera: {name} moves them to the LiDAR")
    else:
        is_shifted = recording.format.startswith("folder") and recording.start < SINCE_1970
        start = 1e-9 * (recording.start - FIRST_STAMP * is_shifted)
        times, choice = _align(table, sweeps, start)
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


def _poses_of_sweeps(table: PoseTable, path: Path, recording: Recording) -> tuple[PoseTable, str]:
    """Return one pose per sweep: all poses or, where there are more, those with the numbers of the clouds; a notice.

    Raises:
        UserError: the poses are not those of the sweeps.
    """
    count, sweeps, numbers = len(table.positions), len(recording.sweep_times), recording.sweep_numbers
    if table.numbers is None and count == sweeps:
        return table, ""
    named = range(count) if table.numbers is None else table.numbers.tolist()
    row_of = {number: row for row, number in enumerate(named)}
    if numbers is None or not row_of.keys() >= set(numbers) or (table.numbers is None and count < sweeps):
        raise UserError(
            f"{path} has {count} poses and {recording.path} {sweeps} sweeps: text without times must have one pose per "
            "sweep, or one for the number in the name of each cloud; give TUM text, which has times, with --poses, or "
            "estimate the motion with --odometry kiss-icp."
        )
    rows = [row_of[number] for number in numbers]
    chosen = table._replace(positions=table.positions[rows], quaternions=table.quaternions[rows])
    return chosen, f"of the {count} poses of {path.name}, those with the numbers in the names of the clouds are used"


def _camera_mount(poses: Path, recording: Path) -> tuple[Path, NDArray[np.float64]] | None:
    """Return KITTI's calibration near the poses or the clouds, and the pose of the LiDAR in its camera [4, 4].

    Raises:
        UserError: it holds something else than a pose.
    """
    for folder in dict.fromkeys((poses.parent, recording, recording.parent)):
        try:
            lines = read_user_text(folder / "calib.txt", limit=_LINE_MAX).splitlines()
        except (OSError, ValueError):
            continue
        for line in lines:
            name, _, numbers = line.partition(":")
            if name.strip() in ("Tr", "Tr_velo_to_cam") and len(numbers.split()) == 12:
                matrix = np.eye(4)
                with suppress(ValueError):
                    matrix[:3] = np.array(numbers.split(), np.float64).reshape(3, 4)
                    if np.abs(matrix).max() <= _MOUNT_MAX and _is_rotation(matrix[:3, :3]):
                        return folder / "calib.txt", matrix
                raise UserError(f"{folder / 'calib.txt'} has no pose of the LiDAR at {name}: correct or remove it.")
    return None


def _is_rotation(matrix: NDArray[np.float64]) -> bool:
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < 0.1 and np.linalg.det(matrix) > 0.0)


def _move_to_sensor(table: PoseTable, mount: NDArray[np.float64]) -> PoseTable:
    """Return the poses of a sensor from those of a camera and the pose of the sensor in it [4, 4]."""
    poses = np.tile(np.eye(4), (len(table.positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation_matrix(table.quaternions), table.positions
    poses = np.linalg.inv(mount) @ poses @ mount
    return table._replace(positions=poses[:, :3, 3], quaternions=quaternion_of_matrix(poses[:, :3, :3]))


def _align(table: PoseTable, sweeps: NDArray[np.float64], start: float) -> tuple[NDArray[np.float64], str]:
    """Return the times of poses from the first sweep on [n] [s], and the assumptions behind them.

    Stamps that overlap those of the sweeps are taken as they are, in the unit in which they do.

    Args:
        table: poses with times.
        sweeps: times of the sweeps from the first one on [m] [s], ascending.
        start: stamp of the first sweep [s].
    """
    ways: list[tuple[str, float | None, float]] = [("", start, 0.0)]
    """Their names, the time that becomes zero, and the least part of the sweeps that they must cover."""
    if table.utc is not None:
        ways.insert(0, ("aligned by GPS time", start - table.utc, 0.0))
    ways += [("counted from the first sweep", 0.0, 0.5)] if not table.is_in_seconds else []
    ways.append(("the first pose is assumed to be that of the first sweep", None, 1.0))
    fits = [(choice, least, *_best_unit(table, sweeps, zero)) for choice, zero, least in ways]
    for is_plausible in (True, False):
        for choice, least, unit, scaled, share in fits:
            inside = np.mean((sweeps >= scaled.min()) & (sweeps <= scaled.max()))
            if inside > least and (share > 0.0 or not is_plausible):
                return scaled, ", ".join(filter(None, (choice, unit)))
    choice, _, unit, scaled, _ = fits[-1]
    return scaled, ", ".join(filter(None, (choice, unit)))


def _best_unit(
    table: PoseTable, sweeps: NDArray[np.float64], zero: float | None
) -> tuple[str, NDArray[np.float64], float]:
    """Return the unit in which times fit the sweeps best, the times after zero [n] [s], and how well they fit, 0 to 1.

    The measure is the time that poses and sweeps have in common, as a share of the time that either has. It is 0 where
    poses would be implausibly close or far apart in every unit; then the unit is the second, whose name is empty.

    Args:
        table: poses with times.
        sweeps: times of the sweeps [m] [s], ascending.
        zero: time that becomes zero [s]; None takes that of the first pose.
    """
    assert table.times is not None
    times = table.times
    if zero is None:
        times, zero = times - times[0], 0.0
    end = sweeps[-1] + POSE_TOLERANCE
    step = np.median(np.diff(np.sort(times))) if len(times) > 1 else 0.0
    best = ("", times - zero, 0.0)
    for name, unit in [("", 1.0)] if table.is_in_seconds else _UNITS.items():
        scaled = times * unit - zero
        start, stop = scaled.min(), scaled.max()
        common = min(stop, end) - max(start, sweeps[0])
        share = max(float(common), 0.0) / max(float(max(stop, end) - min(start, sweeps[0])), 1e-9)
        if share > best[2] and (not step or _STEP_MIN <= step * unit < _STEP_MAX):
            best = (name, scaled, share)
    return best
