"""Poses of sweeps in a known map, one registration after another; a sweep that does not fit has none, and is named."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import integrate_rates, quaternion_of_matrix, rotation_vector
from aero_viz.errors import UserError
from aero_viz.recordings.alignment import place
from aero_viz.recordings.map_cloud import read_map_cloud
from aero_viz.recordings.odometry import Motion, OdometryProgress
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.registration import Fit, Surface
from aero_viz.recordings.transforms import Transform, matrix_of

if TYPE_CHECKING:
    from aero_viz.recordings.recording import PointSweep, Recording

Array = NDArray[np.float64]
_Located: TypeAlias = tuple[int, float, Fit]
"""Number of a sweep, time in the middle of a slice of it [s], and its fit."""

_MIN_RANGE, _MAX_RANGE = 0.5, 30.0
"""Ranges of the points that are registered [m]."""
_MAP_MARGIN = 10.0
"""Way after which another part of the map is taken [m]."""
_MAX_ACCELERATION, _SLACK = 60.0, 0.8
"""No drone accelerates more, and no registration is that far off: a pose farther from where the motion led is wrong
[m/s^2], [m]."""
_FITNESS_MIN = 0.75
"""Poses that are metres off fit to 0.58 among trees and to 0.72 in halls."""
_START_OFF = 2.0
"""Distance from the start beyond which a fit is another place [m]."""
_SLICE = 0.05
"""Time in which a drone turns and moves little: sweeps are registered in slices [s]."""
_RUNS = 5
"""Runs of lost sweeps that are described."""
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
        if problem := fit.problem(least=_FITNESS_MIN):
            return problem
        off = float(np.linalg.norm(fit.pose[:3, 3] - guess[:3, 3]))
        passed = when - self._known[-1][0] if self._known else np.inf
        if off > (_SLACK + 0.5 * _MAX_ACCELERATION * passed**2 if passed < _BLIND else _START_OFF):
            return f"it fits only {off:.1f} m from where it was expected"
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

    With poses, the motion during a sweep is corrected by them. Without, slices of the sweeps are registered as they
    were measured, then once more, corrected by the motion that was found.

    Args:
        recording: the sweeps, and the poses that give a first guess of the motion, if it has any.
        cloud: points of the map [n, 3] [m].
        start: pose of the body at the first sweep, in the map; a metre and 15 degrees off will do.
        progress: called after every sweep.

    Raises:
        UserError: hardly any sweep fits.
    """
    tracker = _Tracker(cloud, matrix_of(*start), recording.poses)
    count = len(recording.sweep_times)
    lost: dict[int, tuple[float, str]] = {}
    rough: list[_Located] = []
    ms = []
    known = recording.poses
    for index in range(count):
        began = time.perf_counter()
        for part in _slices(near(recording.sweep(index)), whole=known is not None):
            when = middle_of(part)
            found = tracker.locate(part.points if known is None else in_body(part, known, when), when)
            if isinstance(found, str):
                lost.setdefault(index, (when, found))
            elif not rough or when > rough[-1][1]:
                rough.append((index, when, found))
        ms.append(1e3 * (time.perf_counter() - began))
        progress(index + 1, count)
    fine = rough if known is not None or len(rough) < 2 else list(_refined(recording, tracker, rough))
    for index, when, fit in fine:
        if problem := fit.problem(least=_FITNESS_MIN):
            lost.setdefault(index, (when, problem))
    fine = [(index, when, fit) for index, when, fit in fine if not fit.problem(least=_FITNESS_MIN)]
    if len(fine) < 2:
        at, reason = next(iter(lost.values()), (0.0, "there is a single sweep"))
        raise UserError(
            f"{recording.path} is not found in the map: at {at:.1f} s, {reason}. Give --map-start, the pose in the map "
            "from which it starts, to a metre and 15 degrees."
        )
    fitness = float(np.median([fit.fitness for *_, fit in fine]))
    return _motion(fine)._replace(ms_per_sweep=float(np.median(ms)), problems=_describe(lost), fitness=fitness)


def _refined(recording: Recording, tracker: _Tracker, rough: list[_Located]) -> Iterator[_Located]:
    """Yield the fits of slices that are corrected by the motion that was found."""
    track, parts, read = _motion(rough).poses(), {}, -1
    for index, when, fit in rough:
        if index != read:
            parts, read = {middle_of(part): part for part in _slices(near(recording.sweep(index)))}, index
        part = parts[when]
        is_moved = part.point_times is not None
        yield index, when, tracker.fit(in_body(part, track, when), fit.pose) if is_moved else fit


def _slices(sweep: PointSweep, *, whole: bool = False) -> list[PointSweep]:
    """Return the parts of a sweep that were measured within `_SLICE` each; without times of points, the whole one."""
    times = sweep.point_times
    if whole or times is None or not len(times):
        return [sweep]
    number = np.floor((times - times.min()) / max(_SLICE, float(np.ptp(times)) / 16 + 1e-6)).astype(int)
    kept = [np.flatnonzero(number == i) for i in range(number.max() + 1)]
    return [sweep._replace(points=sweep.points[rows], point_times=times[rows]) for rows in kept if len(rows)]


def _motion(found: list[_Located]) -> Motion:
    """Return the poses at the times [s] of slices of sweeps as a motion."""
    times = np.array([when for _, when, _ in found])
    poses = np.array([fit.pose for *_, fit in found])
    return Motion("ICP in a map", times, poses[:, :3, 3], quaternion_of_matrix(poses[:, :3, :3]), 0.0, ())


def _describe(lost: dict[int, tuple[float, str]]) -> tuple[str, ...]:
    """Return a sentence for each run of sweeps that have no pose, or lack one for a part: time [s] and reason each."""
    runs: list[list[int]] = []
    for index in sorted(lost):
        if runs and runs[-1][-1] == index - 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    sentences = []
    for run in runs[:_RUNS]:
        (begin, reason), (end, _) = lost[run[0]], lost[run[-1]]
        which = f"sweep {run[0]} at {begin:.1f} s"
        if len(run) > 1:
            which = f"sweeps {run[0]} to {run[-1]}, from {begin:.1f} to {end:.1f} s"
        sentences.append(f"no pose in the map for {which}: {reason}")
    if len(runs) > _RUNS:
        sentences.append(f"no pose in the map for {len(lost)} sweeps in all")
    return tuple(sentences)


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


def in_body(sweep: PointSweep, poses: RecordedPoses, when: float) -> Array:
    """Return the points of a sweep in the frame of the body at a time [s], each moved by the pose at its own time."""
    pose = pose_matrix(poses, when)
    return (place(sweep, poses) - pose[:3, 3]) @ pose[:3, :3]


def pose_matrix(poses: RecordedPoses, when: float) -> Array:
    """Return the recorded pose at a time [s], or the first or last one before or after all, [4, 4]."""
    return matrix_of(*poses.track.interpolate(float(np.clip(when, poses.track.times[0], poses.track.times[-1]))))
