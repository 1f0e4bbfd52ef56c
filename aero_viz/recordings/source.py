"""A recording as a source for the engine: what the planner would have done, at every recorded pose."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Goal, Plan, VehicleState
from aero_planner.quaternions import rotate, rotation_matrix
from aero_viz.errors import UserError
from aero_viz.recordings.poses import POSE_TOLERANCE, Pose
from aero_viz.recordings.recording import PointSweep, Recording
from aero_viz.session.source import Observation, Scenery

__all__ = ["MAX_POINTS", "RecordedPath", "RecordingSource"]

MAX_POINTS = 200_000
"""The planner's clouds hold at most this many points; a sweep is used whole or not at all, the newest always."""

_PATH_SPACING = 0.2
_SHORTEST_PATH = 1.0
_SPARSEST_POSES = 0.2
_DESKEW_STEP = 1e-4


class RecordedPath:
    """The recorded positions as a curve, by arc length.

    A vertex is kept when it is 0.2 m from the one before: the jitter of a standing drone would otherwise add up to
    metres of path.
    """

    def __init__(self, times: NDArray[np.float64], positions: NDArray[np.float64]):
        kept = [0]
        for i, position in enumerate(positions):
            if np.linalg.norm(position - positions[kept[-1]]) >= _PATH_SPACING:
                kept.append(i)
        self._times, self._vertices = times[kept], positions[kept]
        self._lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._vertices, axis=0), axis=1))])

    def ahead(self, time: float, distance: float) -> NDArray[np.float64] | None:
        """Return the point `distance` [m] of arc length after the position at `time` [s], shape [3].

        The path's end stands in where it is nearer, and None where less than 1 m of path is left.
        """
        here = float(np.interp(time, self._times, self._lengths))
        if self._lengths[-1] - here < min(_SHORTEST_PATH, distance):
            return None
        there = min(here + distance, self._lengths[-1])
        return np.array([np.interp(there, self._lengths, axis) for axis in self._vertices.T])


class _Checkpoint(NamedTuple):
    index: int
    outcome: str | None
    goal: NDArray[np.float64] | None
    goal_ahead: float


class RecordingSource:
    """Plays a recording through the planner, open loop: the plan is shown, the recorded motion goes on.

    A tick is a recorded pose, from the first pose with a sweep to the last sweep; without poses a tick is a sweep and
    the sensor stands at the origin. The observation holds the last `sweeps` sweeps at or before the tick, each moved
    to the world by the pose at its own time, but no more of them than `MAX_POINTS` points allow.

    Deskew: where a sweep has a time per point and the recorded poses around it are at most 0.2 s apart, each point is
    moved by the pose at its own time (in steps of 0.1 ms); otherwise the whole sweep by the pose at its stamp, which
    on a moving sensor leaves it bent by the motion during the sweep.
    """

    closed_loop = False

    def __init__(self, recording: Recording, *, goal_ahead: float = 15.0, sweeps: int = 10):
        if sweeps < 1:
            raise UserError(f"sweeps must be at least 1, not {sweeps}: the planner needs a cloud")
        self.recording = recording
        self.sweeps = sweeps
        self.goal_ahead = goal_ahead
        track = recording.poses
        self._ticks: NDArray[np.float64] = recording.sweep_times
        self._path: RecordedPath | None = None
        if track is not None:
            inside = (track.times >= 0.0) & (track.times <= recording.sweep_times[-1] + POSE_TOLERANCE)
            if inside.any():
                self._ticks = track.times[inside]
            self._path = RecordedPath(track.times, track.positions)
        self.times: NDArray[np.float64] | None = self._ticks
        self.name = recording.path.name
        self.period = float(np.median(np.diff(self._ticks))) if len(self._ticks) > 1 else 0.1
        self.outcome: str | None = None
        path = None if track is None else track.positions
        self.scenery = Scenery(
            start=self._pose(float(self._ticks[0])).position,
            recorded_path=path,
            notices=("open loop: the plan is shown, not flown", *recording.problems),
        )
        self._index = 0
        self._goal: NDArray[np.float64] | None = None
        self._clouds: OrderedDict[int, NDArray[np.float32]] = OrderedDict()
        self._joined: tuple[tuple[int, int], NDArray[np.float32]] | None = None

    @property
    def goal_ahead(self) -> float:
        """How far along the recorded path the goal lies [m]; may be set at any time. Raises UserError unless > 0."""
        return self._goal_ahead

    @goal_ahead.setter
    def goal_ahead(self, distance: float) -> None:
        if not (np.isfinite(distance) and distance > 0):
            raise UserError(f"goal_ahead must be a positive number of metres, not {distance}")
        self._goal_ahead = float(distance)

    @property
    def explanation(self) -> str | None:
        """In one sentence which sweeps could not be read so far; None while all could."""
        return self.recording.damage

    def observe(self) -> Observation:
        """Return what the planner sees at this tick."""
        time = float(self._ticks[self._index])
        pose = self._pose(time)
        state = VehicleState(pose.position, pose.velocity, pose.quaternion, time=time)
        first, last = self._window(time)
        age = time - float(self.recording.sweep_times[last - 1]) if last > first else 0.0
        goal = Goal(self._goal_at(time, pose))
        return Observation(time, state, goal, self._cloud(first, last), last - first, cloud_age=max(age, 0.0))

    def advance(self, plan: Plan | None = None) -> None:
        """Go to the next recorded pose; the plan is not flown. After the last one the outcome is "end"."""
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
        self._index, self.outcome, self._goal, self._goal_ahead = checkpoint

    def seek(self, time: float) -> None:
        """Go to the tick at or before `time` [s]; the first or last tick for times outside the recording."""
        if not np.isfinite(time):
            raise UserError(f"cannot seek to {time} s: name a time between {self._ticks[0]} and {self._ticks[-1]} s")
        index = int(np.searchsorted(self._ticks, time, side="right")) - 1
        self._index = min(max(index, 0), len(self._ticks) - 1)
        self.outcome = None

    def set_goal(self, position: ArrayLike | None) -> None:
        """Fix the goal at `position` [m], shape [3], world; None lets it run ahead on the recorded path again."""
        if position is None:
            self._goal = None
            return
        goal = np.array(position, np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise UserError(f"a goal is three finite numbers [m], not {position}")
        self._goal = goal

    def close(self) -> None:
        """Close the recording."""
        self._clouds.clear()
        self._joined = None
        self.recording.close()

    def _pose(self, time: float) -> Pose:
        track = self.recording.poses
        if track is None:
            return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
        return track.at(time)

    def _goal_at(self, time: float, pose: Pose) -> NDArray[np.float64]:
        if self._goal is not None:
            return self._goal
        goal = None if self._path is None else self._path.ahead(time, self._goal_ahead)
        if goal is not None:
            return goal
        # A drone that stands or has arrived: level, where its nose points.
        forward = rotate(pose.quaternion, np.array([1.0, 0.0, 0.0]))
        heading = np.arctan2(forward[1], forward[0])
        return pose.position + self._goal_ahead * np.array([np.cos(heading), np.sin(heading), 0.0])

    def _window(self, time: float) -> tuple[int, int]:
        """Return the range of sweeps that the planner sees at `time`: never empty, the newest first to be kept."""
        last = max(int(np.searchsorted(self.recording.sweep_times, time, side="right")), 1)
        first, total = last - 1, len(self._world(last - 1))
        while first > 0 and last - first < self.sweeps:
            total += len(self._world(first - 1))
            if total > MAX_POINTS:
                break
            first -= 1
        return first, last

    def _cloud(self, first: int, last: int) -> NDArray[np.float32]:
        """Return sweeps first..last-1 in the world; the last result is kept, poses being faster than sweeps."""
        if self._joined is None or self._joined[0] != (first, last):
            cloud = np.concatenate([self._world(i) for i in range(first, last)])
            cloud.flags.writeable = False
            self._joined = ((first, last), cloud)
        return self._joined[1]

    def _world(self, index: int) -> NDArray[np.float32]:
        """Return one sweep in the world [m], shape [P, 3]; as many as one observation needs are kept."""
        if index in self._clouds:
            self._clouds.move_to_end(index)
        else:
            self._clouds[index] = self._moved(self.recording.sweep(index))
            if len(self._clouds) > self.sweeps + 2:
                self._clouds.popitem(last=False)
        return self._clouds[index]

    def _moved(self, sweep: PointSweep) -> NDArray[np.float32]:
        track = self.recording.poses
        if track is None or not len(sweep.points):
            return sweep.points
        if sweep.point_times is not None:
            step = np.round(sweep.point_times / _DESKEW_STEP).astype(np.int32)
            low, high = int(step.min()), int(step.max())
            start, stop = sweep.time + low * _DESKEW_STEP, sweep.time + high * _DESKEW_STEP
            if track.widest_spacing(start, stop) <= _SPARSEST_POSES:
                poses = track.at(np.linspace(start, stop, high - low + 1))
                rotation = rotation_matrix(poses.quaternion).astype(np.float32)[step - low]
                moved = np.einsum("nij,nj->ni", rotation, sweep.points)
                return moved + poses.position.astype(np.float32)[step - low]
        pose = track.at(sweep.time)
        return sweep.points @ rotation_matrix(pose.quaternion).T.astype(np.float32) + pose.position.astype(np.float32)
