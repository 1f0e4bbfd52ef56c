"""Poses of sweeps in a known map, one registration after another; a sweep that does not fit has none, and is named."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import integrate_rates, quaternion_of_matrix, rotation_matrix, rotation_vector
from aero_viz.errors import UserError
from aero_viz.recordings.alignment import place
from aero_viz.recordings.map_cloud import read_map_cloud
from aero_viz.recordings.odometry import Motion, OdometryProgress
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.registration import Fit, Surface
from aero_viz.recordings.transforms import Transform

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

Array = NDArray[np.float64]

_MIN_RANGE, _MAX_RANGE = 0.5, 40.0
"""Ranges of the points that are registered [m]."""
_MAP_MARGIN = 15.0
"""Way after which another part of the map is taken [m]."""
_MAX_ACCELERATION, _SLACK = 60.0, 0.3
"""No drone accelerates more, and no registration is that far off: a pose farther from where the motion led is wrong
[m/s^2], [m]."""
_BLIND = 1.0
"""Time without a pose after which the motion before says nothing [s]."""


class _Tracker:
    """Registers sweeps with a map, each from where the motion before leads to.

    Args:
        cloud: points of the map [n, 3] [m].
        start: pose of the body at the first sweep, in the map [4, 4].
        recorded: poses whose motion from sweep to sweep is taken as a first guess; None guesses a constant velocity.
    """

    def __init__(self, cloud: Array, start: Array, recorded: RecordedPoses | None) -> None:
        self._cloud, self._recorded = cloud, recorded
        self._part: tuple[Array, Surface] | None = None
        self._known: list[tuple[float, Array]] = []
        self._start = start

    def locate(self, points: NDArray[np.floating], when: float) -> Fit | str:
        """Return the fit of a sweep [n, 3] [m], body frame, at a time [s]; or why it has none."""
        guess = self._guess(when)
        fit = self.fit(points, guess)
        if problem := fit.problem:
            return problem
        if self._known and (passed := when - self._known[-1][0]) < _BLIND:
            off = float(np.linalg.norm(fit.pose[:3, 3] - guess[:3, 3]))
            if off > _SLACK + 0.5 * _MAX_ACCELERATION * passed**2:
                return f"it fits {off:.1f} m from where the motion before led"
        self._known.append((when, fit.pose))
        return fit

    def fit(self, points: NDArray[np.floating], guess: Array) -> Fit:
        """Return the fit of points [n, 3] [m], body frame, near a pose [4, 4]."""
        position = guess[:3, 3]
        if self._part is None or np.linalg.norm(position - self._part[0]) > _MAP_MARGIN:
            distance = np.linalg.norm(self._cloud - position, axis=1)
            self._part = position, Surface(self._cloud[distance < _MAX_RANGE + _MAP_MARGIN])
        return self._part[1].fit(points, guess)

    def _guess(self, when: float) -> Array:
        if not self._known:
            return self._start
        at, pose = self._known[-1]
        if self._recorded is not None:
            before, now = (pose_matrix(self._recorded, t) for t in (at, when))
            return pose @ np.linalg.inv(before) @ now
        if len(self._known) < 2:
            return pose
        earlier, first = self._known[-2]
        share = min(when - at, _BLIND) / (at - earlier)
        step = np.linalg.inv(first) @ pose
        turn = rotation_vector(quaternion_of_matrix(step[:3, :3]))
        return pose @ matrix_of(share * step[:3, 3], integrate_rates([1.0, 0.0, 0.0, 0.0], turn, share))


def read_map_points(path: Path) -> Array:
    """Return the points of a map [n, 3] [m]: a file of points, or a bag with one cloud.

    Raises:
        UserError: it cannot be read, or is none of these.
    """
    from aero_viz.scenes.map_files import has_voxels, read_points

    if path.is_dir() or not has_voxels(path):
        return read_map_cloud(path)
    return read_points(path)


def locate_in_map(
    recording: Recording,
    cloud: Array,
    start: Transform,
    *,
    progress: OdometryProgress = lambda done, total: None,
) -> Motion:
    """Return the motion of the body in the frame of a map.

    Sweeps are registered as they were measured, then once more, corrected by the motion that was found.

    Args:
        recording: the sweeps, and the poses that give a first guess of the motion, if it has any.
        cloud: points of the map [n, 3] [m].
        start: pose of the body at the first sweep, in the map; a metre and 15 degrees off will do.
        progress: called after every sweep.

    Raises:
        UserError: hardly any sweep fits.
    """
    tracker = _Tracker(cloud, matrix_of(*start), recording.poses)
    count, lost = len(recording.sweep_times), []
    rough: dict[int, tuple[float, Fit]] = {}
    ms = []
    for index in range(count):
        sweep = near(recording.sweep(index))
        began, when = time.perf_counter(), middle_of(sweep)
        found = tracker.locate(sweep.points, when)
        ms.append(1e3 * (time.perf_counter() - began))
        if isinstance(found, str):
            lost.append((index, when, found))
        else:
            rough[index] = when, found
        progress(index + 1, 2 * count)
    if len(rough) < 2:
        _, at, reason = lost[0]
        raise UserError(
            f"{recording.path} is not found in the map: at {at:.1f} s, {reason}. Give --map-start, the pose in the map "
            "from which it starts, to a metre and 15 degrees."
        )
    track, fine = _motion(rough).poses().without_offset(), dict(rough)
    for index, (when, fit) in rough.items():
        sweep = near(recording.sweep(index))
        if sweep.point_times is None:
            continue
        middle = pose_matrix(track, when)
        fine[index] = when, tracker.fit((place(sweep, track) - middle[:3, 3]) @ middle[:3, :3], fit.pose)
        if problem := fine[index][1].problem:
            lost.append((index, when, problem))
            del fine[index]
        progress(count + index + 1, 2 * count)
    fitness = float(np.median([fit.fitness for _, fit in fine.values()]))
    problems = tuple(describe_lost(sorted(lost), count))
    return _motion(fine)._replace(ms_per_sweep=float(np.median(ms)), problems=problems, fitness=fitness)


def _motion(found: dict[int, tuple[float, Fit]]) -> Motion:
    """Return the poses of sweeps at their times [s] as a motion."""
    times = np.array([when for when, _ in found.values()])
    poses = np.array([fit.pose for _, fit in found.values()])
    kept = np.append(True, np.diff(times) > 0.0)
    times, poses = times[kept], poses[kept]
    return Motion("ICP in a map", times, poses[:, :3, 3], quaternion_of_matrix(poses[:, :3, :3]), 0.0, ())


def describe_lost(lost: list[tuple[int, float, str]], count: int) -> list[str]:
    """Return a sentence for each run of sweeps (number, time [s], reason) without a pose."""
    runs: list[list[tuple[int, float, str]]] = []
    for entry in lost:
        if runs and runs[-1][-1][0] == entry[0] - 1:
            runs[-1].append(entry)
        else:
            runs.append([entry])
    sentences = []
    for run in runs[:5]:
        (first, begin, reason), (last, end, _) = run[0], run[-1]
        which = f"sweep {first} at {begin:.1f} s" if first == last else (
            f"sweeps {first} to {last}, from {begin:.1f} to {end:.1f} s")  # fmt: skip
        sentences.append(f"no pose for {which}: {reason}")
    if len(runs) > 5:
        sentences.append(f"no pose for {len(lost)} of {count} sweeps in all")
    return sentences


def middle_of(sweep: PointSweep) -> float:
    """Return the time in the middle of a sweep [s]."""
    if sweep.point_times is None or not len(sweep.point_times):
        return sweep.time
    return sweep.time + 0.5 * float(sweep.point_times.min() + sweep.point_times.max())


def near(sweep: PointSweep) -> PointSweep:
    """Return a sweep with the points that are registered."""
    distance = np.linalg.norm(sweep.points, axis=1)
    kept = (distance > _MIN_RANGE) & (distance < _MAX_RANGE)
    times = None if sweep.point_times is None else sweep.point_times[kept]
    return sweep._replace(points=sweep.points[kept], point_times=times)


def pose_matrix(poses: RecordedPoses, when: float) -> Array:
    """Return the recorded pose at a time [s], or the first or last one before or after all, [4, 4]."""
    return matrix_of(*poses.track.interpolate(float(np.clip(when, poses.track.times[0], poses.track.times[-1]))))


def matrix_of(position: Array, quaternion: Array) -> Array:
    """Return a pose as a matrix [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(quaternion), position
    return matrix
