"""Poses for recordings without any: LiDAR odometry by rko-lio (with an IMU) or kiss-icp, and checks of the result."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_of_matrix, rotation_matrix
from aero_viz.errors import UserError
from aero_viz.extras import from_extra
from aero_viz.recordings.imu import ImuSamples
from aero_viz.recordings.imu_smoothing import smooth_motion
from aero_viz.recordings.odometry_choice import OdometryChoice
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.transforms import IDENTITY, Transform, matrix_of

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

OdometryProgress = Callable[[int, int], None]
"""Called with the number of sweeps that are done and the number of all sweeps."""

_MIN_RANGE, _MAX_RANGE = 0.3, 60.0
"""Ranges of the points that are registered [m]."""
_KISS_VOXEL, _RKO_VOXEL = 0.6, 0.5
"""Sizes of the voxels of the maps [m]."""
_RKO_DISTANCE = 0.3
"""Largest distance between matched points [m]: trunks and branches are thin."""
_RKO_JERK = 100.0
"""A drone's acceleration changes faster than that of the vehicles for which the default was chosen [m/s^3]."""
_REST_TIME = 0.2
"""Time at the start over which the mean specific force is taken as gravity [s]."""
_MAX_SPEED, _MAX_ACCELERATION = 40.0, 60.0
"""No drone is faster, or brakes or accelerates more; an estimate beyond these limits is wrong [m/s], [m/s^2]."""
_MAX_LOST = 0.1
"""Share of sweeps without a pose beyond which the odometry has failed."""
_MIN_FIT = 0.5
"""Share of points that must lie on surfaces seen by the sweeps before, or else the estimate has probably drifted."""


class Motion(NamedTuple):
    """Estimated motion of the body."""

    method: str
    """"rko-lio", "kiss-icp" or "ICP in a map"."""
    times: NDArray[np.float64]
    """[n] [s] after the first playable sweep: the end of each registered sweep."""
    positions: NDArray[np.float64]
    """[n, 3] [m]; the origin is where the first sweep ends."""
    quaternions: NDArray[np.float64]
    """[n, 4] w, x, y, z, body to world; z is up where an IMU was recorded, and the first body z axis otherwise."""
    ms_per_sweep: float
    """Median time of a registration [ms]."""
    problems: tuple[str, ...]
    """Signs of failure and drift, and assumptions, one sentence each."""
    fitness: float = float("nan")
    """Median share of the points of a sweep that lie on the surfaces of a map; NaN without one."""

    def poses(self) -> RecordedPoses:
        """Return the motion as recorded poses."""
        return RecordedPoses(self.times, self.positions, self.quaternions)


def choose_method(choice: OdometryChoice, imu: ImuSamples | None, *, timed: bool) -> str:
    """Return "rko-lio" or "kiss-icp".

    Args:
        choice: method that the user asked for; "auto" is rko-lio with an IMU and a time per point, else kiss-icp.
        imu: the IMU of the recording.
        timed: True if the points have times.

    Raises:
        UserError: rko-lio was asked for and cannot work.
    """
    lacking = "no sensor_msgs/Imu" if imu is None else "" if timed else "no time per point"
    if choice == "rko-lio" and lacking:
        raise UserError(
            f"--odometry rko-lio needs an IMU and a time per point, and {lacking} is recorded: use kiss-icp."
        )
    if choice == "auto":
        return "kiss-icp" if lacking else "rko-lio"
    return choice


def estimate_motion(
    recording: Recording,
    method: str,
    imu: ImuSamples | None,
    *,
    imu_mount: Transform = IDENTITY,
    start: int = 0,
    progress: OdometryProgress = lambda done, total: None,
) -> Motion:
    """Register all sweeps of a recording one after the other, and smooth the poses by the IMU.

    Args:
        recording: the sweeps, in the body frame.
        method: "rko-lio" or "kiss-icp".
        imu: samples for rko-lio, and for the direction of gravity; None is without.
        imu_mount: pose of the IMU in the body's frame.
        start: stamp of the first playable sweep [ns].
        progress: called after every sweep.

    Raises:
        UserError: the library is not installed, or it failed on nearly all sweeps.
    """
    level = level_of(imu, imu_mount, start)
    register = (RkoLio(imu, imu_mount, level, start) if imu else None) if method == "rko-lio" else KissIcp(level)
    assert register is not None
    times: list[float] = []
    matrices: list[NDArray[np.float64]] = []
    ms: list[float] = []
    count = len(recording.sweep_times)
    for index in range(count):
        sweep = recording.sweep(index)
        began = time.perf_counter()
        with _silent_stdout():
            matrix = register(sweep) if len(sweep.points) else None
        ms.append(1e3 * (time.perf_counter() - began))
        posed = time_in_sweep(sweep, register.posed_at)
        if matrix is not None and np.isfinite(matrix).all() and (not times or posed > times[-1]):
            times.append(posed)
            matrices.append(matrix)
        progress(index + 1, count)
    if len(times) < max(2, (1.0 - _MAX_LOST) * count):
        raise UserError(
            f"{method} found poses for only {len(times)} of {count} sweeps of {recording.path}: "
            "try the other --odometry, or record poses."
        )
    poses = np.array(matrices)
    motion = Motion(
        method, np.array(times), poses[:, :3, 3], quaternion_of_matrix(poses[:, :3, :3]), float(np.median(ms)), ()
    )
    problems = _signs_of_failure(motion, count)
    if imu is not None and method == "rko-lio":
        smooth = smooth_motion(motion.times, motion.positions, motion.quaternions, imu, imu_mount, start)
        motion = motion._replace(positions=smooth[0], quaternions=smooth[1])
    problems += _signs_of_drift(recording, motion)
    if imu is None:
        problems.append("no IMU is recorded: the sensor is assumed to be level at the start")
    return motion._replace(problems=tuple(problems))


def time_in_sweep(sweep: PointSweep, share: float) -> float:
    """Return the time at which a share of a sweep was measured [s]."""
    if sweep.point_times is None:
        return sweep.time
    first, last = float(sweep.point_times.min()), float(sweep.point_times.max())
    return sweep.time + (1.0 - share) * first + share * last


class KissIcp:
    """Registers sweeps by kiss-icp, which predicts a constant velocity.

    It would correct the motion during a sweep by that of the sweep before. For a drone that accelerates, this
    correction is wrong, and the error carries over to the next sweep. Sweeps are therefore registered as they were
    measured, and the pose is that in the middle of the sweep.
    """

    posed_at = 0.5

    def __init__(self, level: NDArray[np.float64]) -> None:
        with from_extra("odometry", "Poses from the sweeps (--odometry)"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        config = KISSConfig()
        config.data.min_range, config.data.max_range = _MIN_RANGE, _MAX_RANGE
        config.mapping.voxel_size, config.data.deskew = _KISS_VOXEL, False
        self._kiss, self._level = KissICP(config), level

    def __call__(self, sweep: PointSweep) -> NDArray[np.float64]:
        """Return the pose of the body in the middle of a sweep, [4, 4]."""
        self._kiss.register_frame(sweep.points.astype(np.float64), np.zeros(0))
        return self._level @ self._kiss.last_pose


class RkoLio:
    """Registers sweeps by rko-lio, which predicts the motion from an IMU."""

    posed_at = 1.0

    def __init__(self, imu: ImuSamples | None, mount: Transform, level: NDArray[np.float64], start: int) -> None:
        with from_extra("odometry", "Poses from the sweeps (--odometry)"):
            from rko_lio.lio import LIO, LIOConfig
            from rko_lio.rko_lio_pybind import InputError
        _silence_exit()
        config = LIOConfig(min_range=_MIN_RANGE, max_range=_MAX_RANGE, voxel_size=_RKO_VOXEL)
        config.max_correspondence_distance, config.max_expected_jerk = _RKO_DISTANCE, _RKO_JERK
        self._lio, self._failure = LIO(config), InputError
        self._samples: deque[tuple[int, NDArray[np.float64], NDArray[np.float64]]] = deque()
        self._start = start
        if imu is not None:
            self.add_imu(imu)
        # Its own search for gravity needs a drone at rest. Here the base is level at the start, so that none is needed.
        self._level, self._mount = level, level @ matrix_of(*mount)

    def add_imu(self, imu: ImuSamples) -> None:
        """Add samples, which are later than those before."""
        self._samples.extend(zip(imu.times.tolist(), imu.forces, imu.rates, strict=True))

    def __call__(self, sweep: PointSweep) -> NDArray[np.float64] | None:
        """Return the pose of the body at the end of a sweep, [4, 4], None if it could not be registered."""
        assert sweep.point_times is not None
        stamps = self._start + np.round(1e9 * (sweep.time + sweep.point_times.astype(np.float64))).astype(np.int64)
        end = int(stamps.max())
        while self._samples and self._samples[0][0] <= end:
            time, force, rate = self._samples.popleft()
            self._lio.add_imu_measurement(force, rate, time, self._mount)
        try:
            self._lio.register_scan(sweep.points, stamps, self._level)
        except self._failure:
            return None
        return self._lio.pose() @ self._level


@contextlib.contextmanager
def _silent_stdout() -> Iterator[None]:
    """Discard the output of the native libraries, which would appear between the lines of a report."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


@cache
def _silence_exit() -> None:
    """Discard the output of rko-lio when the process ends."""

    def discard() -> None:
        sys.stdout.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    atexit.register(discard)


def level_of(imu: ImuSamples | None, mount: Transform, start: int) -> NDArray[np.float64]:
    """Return the rotation [4, 4] of the body at the start to a frame with z up, the identity without an IMU."""
    matrix = np.eye(4)
    if imu is None:
        return matrix
    first = (imu.times >= start - _REST_TIME * 1e9) & (imu.times <= start + _REST_TIME * 1e9)
    if not first.any():
        return matrix
    up = rotation_matrix(mount.quaternion) @ imu.forces[first].mean(axis=0)
    length = np.linalg.norm(up)
    if not length > 0.0:
        return matrix
    up /= length
    # The shortest rotation of `up` to z.
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), up[2]
    if cosine < -0.999:
        matrix[:3, :3] = np.diag([1.0, -1.0, -1.0])
        return matrix
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix[:3, :3] = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return matrix


def _signs_of_failure(motion: Motion, count: int) -> list[str]:
    problems = []
    if len(motion.times) < count:
        problems.append(f"{motion.method} found no pose for {count - len(motion.times)} of {count} sweeps")
    steps = np.diff(motion.times)
    velocity = np.diff(motion.positions, axis=0) / steps[:, None]
    speed = np.linalg.norm(velocity, axis=1)
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / steps[1:]
    wrong = speed > _MAX_SPEED
    wrong[1:] |= change > _MAX_ACCELERATION
    if wrong.any():
        first = motion.times[int(np.flatnonzero(wrong)[0])]
        problems.append(
            f"{motion.method} has probably failed: from {first:.1f} s its poses jump, in {int(wrong.sum())} places"
        )
    return problems


def _signs_of_drift(recording: Recording, motion: Motion) -> list[str]:
    from aero_viz.recordings.alignment import fit_of_sweeps

    fits = fit_of_sweeps(recording, motion.poses())
    poor = [(at, fit) for at, fit in fits if fit < _MIN_FIT]
    if not poor:
        return []
    at, fit = poor[0]
    return [
        f"{motion.method} has probably drifted: at {at:.1f} s only {100 * fit:.0f} % of the points lie on surfaces "
        f"of the sweeps before, and so at {len(poor)} of {len(fits)} times that were checked"
    ]
