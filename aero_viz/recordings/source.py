"""A recording as a source of the session: at every recorded pose, the plan that the planner would have made."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Arrival, Goal, Sweeps, VehicleState
from aero_planner.plan_inputs import FARTHEST
from aero_planner.quaternions import rotate, rotation_matrix
from aero_planner.sweeps import as_constant
from aero_viz.errors import UserError
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan
from aero_viz.recordings.poses import POSE_TOLERANCE, Pose
from aero_viz.recordings.recording import PointSweep, Recording
from aero_viz.session.source import SourceInfo

MAX_POINTS = 200_000
"""Largest number of points in the planner's cloud. Whole sweeps are used; the newest one always is."""

_PATH_SPACING = 0.2
_MIN_PATH_LEFT = 1.0
MAX_POSE_SPACING = 0.2
"""Longest time between two poses that is interpolated during a sweep [s]."""


class RecordedPath:
    """The recorded positions as a curve over arc length.

    Its vertices are at least 0.2 m apart, because the jitter of a standing drone would otherwise add up to metres.

    Args:
        times: [n] [s], increasing.
        positions: [n, 3] [m], world frame.
    """

    def __init__(self, times: NDArray[np.float64], positions: NDArray[np.float64]):
        kept = [0]
        for i, position in enumerate(positions):
            if np.linalg.norm(position - positions[kept[-1]]) >= _PATH_SPACING:
                kept.append(i)
        self._times, self._vertices = times[kept], positions[kept]
        self._lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._vertices, axis=0), axis=1))])

    def point_after(self, time: float, distance: float) -> NDArray[np.float64] | None:
        """Return the point [3] that lies `distance` [m] of arc length after the position at `time` [s].

        It is the end of the path if less than that is left, and None if less than 1 m is left.
        """
        start = float(np.interp(time, self._times, self._lengths))
        if self._lengths[-1] - start < min(_MIN_PATH_LEFT, distance):
            return None
        length = min(start + distance, self._lengths[-1])
        return np.array([np.interp(length, self._lengths, axis) for axis in self._vertices.T])


@dataclass(frozen=True)
class _Checkpoint:
    index: int
    outcome: str | None
    goal: NDArray[np.float64] | None
    goal_ahead: float


_OPEN_LOOP = "Open loop: motion and clouds are recorded; the plan is computed now, and is not flown."


class RecordingSource:
    """Plays a recording through the planner in open loop: the plan is shown, and the recorded motion continues.

    Each recorded pose is a tick, from the first pose with a sweep to the last sweep. Without poses each sweep is a
    tick, and the sensor stands at the origin. An observation has the last `sweeps` sweeps at or before the tick, or as
    many as `MAX_POINTS` allows, each moved to the world by the poses at its own time.

    If a sweep has a time per point and the poses during it are at most 0.2 s apart, it is deskewed: each point is moved
    by the pose at its own time. Otherwise the whole sweep is moved by the pose at its stamp, which leaves it distorted
    by the motion of the sensor.

    Args:
        recording: recording to play; `close` closes it.
        goal_ahead: distance of the goal along the recorded path [m].
        sweeps: largest number of sweeps in an observation.

    Raises:
        UserError: a number is out of range.
    """

    def __init__(self, recording: Recording, *, goal_ahead: float = 15.0, sweeps: int = 10):
        if sweeps < 1:
            raise UserError(f"sweeps must be at least 1, not {sweeps}: the planner needs a cloud.")
        self.recording = recording
        self.sweeps = sweeps
        self.goal_ahead = goal_ahead
        poses = recording.poses
        self._ticks: NDArray[np.float64] = recording.sweep_times
        self._path: RecordedPath | None = None
        if poses is not None:
            inside = (poses.times >= 0.0) & (poses.times <= recording.sweep_times[-1] + POSE_TOLERANCE)
            if inside.any():
                self._ticks = poses.times[inside]
            self._path = RecordedPath(poses.times, poses.positions)
        self.outcome: str | None = None
        self.info = SourceInfo(
            name=recording.path.name,
            closed_loop=False,
            period=float(np.median(np.diff(self._ticks))) if len(self._ticks) > 1 else 0.1,
            start=self._pose(float(self._ticks[0])).position,
            times=self._ticks,
            recorded_path=None if poses is None else poses.positions,
            notices=(_OPEN_LOOP, *recording.problems),
        )
        self._index = 0
        self._goal: NDArray[np.float64] | None = None
        # As many sweeps as one observation needs.
        self._world_sweep = lru_cache(maxsize=sweeps + 2)(self._compute_world_sweep)
        # Poses are more frequent than sweeps.
        self._sweeps = lru_cache(maxsize=1)(self._collect_sweeps)

    @property
    def goal_ahead(self) -> float:
        """Distance of the goal along the recorded path [m]; may be set at any time. Raises UserError unless > 0."""
        return self._goal_ahead

    @goal_ahead.setter
    def goal_ahead(self, distance: float) -> None:
        if not (np.isfinite(distance) and distance > 0):
            raise UserError(f"goal_ahead must be a positive number of metres, not {distance}.")
        self._goal_ahead = float(distance)

    @property
    def explanation(self) -> str | None:
        """Sentence that names the sweeps found to be unreadable so far; None if there are none."""
        return self.recording.damage

    def observe(self) -> Observation:
        """Return the planner's input at this tick."""
        time = float(self._ticks[self._index])
        pose = self._pose(time)
        state = VehicleState(pose.position, pose.velocity, pose.quaternion, time=time)
        first, last = self._window(time)
        age = time - float(self.recording.sweep_times[last - 1])
        goal = Goal(self._goal_at(time, pose))
        sweeps, sweep_times = self._sweeps(first, last), self.recording.sweep_times[first:last]
        return Observation(time, state, goal, sweeps, cloud_age=max(age, 0.0), sweep_times=sweep_times)

    def advance(self, plan: Plan | None = None) -> None:
        """Go to the next tick; the plan is ignored. After the last tick the outcome is "end"."""
        if self._index + 1 < len(self._ticks):
            self._index += 1
        else:
            self.outcome = "end"

    def checkpoint(self) -> _Checkpoint:
        """Return the tick, the outcome and the goal."""
        return _Checkpoint(self._index, self.outcome, self._goal, self._goal_ahead)

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source."""
        if not isinstance(checkpoint, _Checkpoint):
            raise TypeError(f"expected a checkpoint of a RecordingSource, got {type(checkpoint).__name__}")
        self._index, self.outcome = checkpoint.index, checkpoint.outcome
        self._goal, self._goal_ahead = checkpoint.goal, checkpoint.goal_ahead

    def seek(self, time: float) -> None:
        """Go to the tick at or before `time` [s], or to the first or last one if there is none."""
        if not np.isfinite(time):
            raise UserError(f"Cannot seek to {time} s: give a time between {self._ticks[0]} and {self._ticks[-1]} s.")
        index = int(np.searchsorted(self._ticks, time, side="right")) - 1
        self._index = min(max(index, 0), len(self._ticks) - 1)
        self.outcome = None

    def set_goal(self, position: ArrayLike | None) -> None:
        """Fix the goal at `position` [3] [m], world frame. None moves it along the recorded path again."""
        self._goal = None if position is None else checked_goal(position)

    def close(self) -> None:
        """Close the recording."""
        self._world_sweep.cache_clear()
        self._sweeps.cache_clear()
        self.recording.close()

    def _pose(self, time: float) -> Pose:
        poses = self.recording.poses
        if poses is None:
            return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
        return poses.interpolate(time)

    def _goal_at(self, time: float, pose: Pose) -> NDArray[np.float64]:
        if self._goal is not None:
            return self._goal
        if (recorded := self._recorded_goal(time)) is not None:
            return recorded
        goal = None if self._path is None else self._path.point_after(time, self._goal_ahead)
        if goal is not None:
            return goal
        # The drone stands or has arrived: put the goal at its height, in the direction of its heading.
        forward = rotate(pose.quaternion, np.array([1.0, 0.0, 0.0]))
        heading = np.arctan2(forward[1], forward[0])
        return pose.position + self._goal_ahead * np.array([np.cos(heading), np.sin(heading), 0.0])

    def _recorded_goal(self, time: float) -> NDArray[np.float64] | None:
        """Return the goal [3] [m] that was recorded for `time` [s]; None if there is none."""
        return None

    def _window(self, time: float) -> tuple[int, int]:
        """Return the first sweep of the planner's cloud at `time` [s] and the last one + 1. It is never empty."""
        last = max(int(np.searchsorted(self.recording.sweep_times, time, side="right")), 1)
        first, total = last - 1, len(self._world_sweep(last - 1)[0])
        while first > 0 and last - first < self.sweeps:
            total += len(self._world_sweep(first - 1)[0])
            if total > MAX_POINTS:
                break
            first -= 1
        return first, last

    def _collect_sweeps(self, first: int, last: int) -> Sweeps:
        """Return sweeps first .. last - 1 in the world frame [m]."""
        sweeps, arrivals = zip(*map(self._world_sweep, range(first, last)), strict=True)
        return Sweeps(sweeps, arrivals=arrivals)

    def _compute_world_sweep(self, index: int) -> tuple[NDArray[np.float32], Arrival]:
        """Return a sweep in the world frame [n, 3] [m], read-only, and when and where it was complete.

        The stamp of a sweep may be that of its first point.
        """
        sweep, poses = self.recording.sweep(index), self.recording.poses
        times = sweep.point_times
        end = sweep.time if times is None or not len(times) else sweep.time + float(times.max())
        x, y, z = (0.0, 0.0, 0.0) if poses is None else poses.track.interpolate(end)[0].tolist()
        return as_constant(self._place(sweep)), Arrival(end, (x, y, z))

    def _place(self, sweep: PointSweep) -> NDArray[np.float32]:
        """Return a sweep in the world frame [P, 3] [m]."""
        poses = self.recording.poses
        if poses is None or not len(sweep.points):
            return sweep.points
        if sweep.point_times is not None:
            times = sweep.time + sweep.point_times.astype(np.float64)
            if poses.widest_spacing(float(times.min()), float(times.max())) <= MAX_POSE_SPACING:
                points, _ = poses.track.deskew(sweep.points, times)
                return points
        pose = poses.interpolate(sweep.time)
        return sweep.points @ rotation_matrix(pose.quaternion).T.astype(np.float32) + pose.position.astype(np.float32)


def checked_goal(position: ArrayLike) -> NDArray[np.float64]:
    """Return a goal [m], shape [3]; UserError unless it is three finite numbers that the planner takes."""
    goal = np.array(position, np.float64)
    if goal.shape != (3,) or not np.isfinite(goal).all():
        raise UserError(f"A goal is three finite numbers [m], not {position}.")
    if np.abs(goal).max() > FARTHEST:
        raise UserError(f"A goal is within {FARTHEST:g} m of the origin, not at {goal.tolist()}.")
    return goal
