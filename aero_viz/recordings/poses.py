"""Recorded poses as a function of time."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import conjugate, multiply, rotate

SPEED_MAX = 1e3
"""A larger component of a velocity [m/s] is not that of a drone."""

POSE_TOLERANCE = 0.1
"""Time before and after a pose for which it can be extrapolated [s]: one sweep of a 10 Hz LiDAR."""

_MIN_LONGEST_GAP = 1.0
MIN_DIFFERENCE_TIME = 0.05
"""Least time over which a velocity is computed from positions [s]."""

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """Poses at n times, or a single one without the leading axis."""

    position: Array
    """[n, 3] [m], world frame minus the offset of the recorded poses."""
    quaternion: Array
    """[n, 4] w, x, y, z, body to world."""
    velocity: Array
    """[n, 3] [m/s], world frame."""


class RecordedPoses:
    """The recorded poses of the body, at least one, in any order.

    Between two poses position and velocity are linear in time and the attitude is slerped. Before the first and after
    the last pose, for `POSE_TOLERANCE`, the body moves at constant velocity without turning. The interpolation is that
    of `PoseTrack`; this class adds velocities, the rules for gaps and ends, and an offset that keeps numbers small.

    Args:
        times: [n] [s]. Of poses at the same time the last one is used.
        positions: [n, 3] [m], world frame.
        quaternions: [n, 4] w, x, y, z, body to world.
        body_velocities: [n, 3] [m/s], body frame, as in the twist of nav_msgs/Odometry. They are ignored if all are
            zero, because many odometries leave them unset, or if any is not finite. Then velocities are central
            differences of the positions over at least 0.05 s on either side, which keeps the noise of frequent pose
            estimates small.
    """

    def __init__(
        self, times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike, body_velocities: ArrayLike | None = None
    ) -> None:
        order, t, p, q = sort_poses(times, positions, quaternions)
        self.offset: Array = p[0].copy()
        """First recorded position [3] [m]. Recorded position = position + offset."""
        self.positions: Array = p - self.offset
        """[n, 3] [m], world frame minus `offset`: small numbers, so that float32 keeps the millimetres."""
        self.times: Array = t
        """[n] [s], increasing."""
        self.velocities: Array = position_differences(t, self.positions)
        """[n, 3] [m/s], world frame."""
        too_fast = (np.abs(self.velocities) > SPEED_MAX).any(axis=1)
        self.velocities[too_fast] = 0.0
        self.jumps = int(too_fast.sum())
        """Number of poses whose velocity is set to zero, because the positions around them are impossibly far apart."""
        self.measured_velocity = False
        """True if the velocities were recorded, False if they are differences of the positions."""
        self.twists: Array | None = None
        """Linear velocities as they were recorded [n, 3] [m/s], NaN where they are not; None if none were recorded."""
        if body_velocities is not None:
            twist = np.asarray(body_velocities, float).reshape(-1, 3)[order]
            self.twists = twist
            if np.isfinite(twist).all() and twist.any():
                self.velocities, self.measured_velocity = rotate(q, twist), True
        self.longest_gap = max(_MIN_LONGEST_GAP, 3.0 * float(np.median(np.diff(t)))) if len(t) > 1 else _MIN_LONGEST_GAP
        """Longest time between two poses that is interpolated [s]."""
        self.quaternions: Array = q
        """[n, 4] w, x, y, z, body to world."""
        self.track = _track_of(self)
        """The poses relative to `offset`, and an extrapolated one at either end."""

    def shifted(self, start: float) -> RecordedPoses:
        """Return the same poses with times counted from `start` [s]."""
        result = copy.copy(self)
        result.times = self.times - start
        result.track = _track_of(result)
        return result

    def turned(self, rotation: Array) -> RecordedPoses:
        """Return the motion of the same body with other axes; `rotation` [4] is from its old axes to the new ones."""
        result = copy.copy(self)
        result.quaternions = multiply(self.quaternions, conjugate(rotation))
        result.twists = None if self.twists is None else rotate(rotation, self.twists)
        result.track = _track_of(result)
        return result

    def without_offset(self) -> RecordedPoses:
        """Return the same poses in the recorded frame: the offset is zero, and far positions lose precision."""
        result = copy.copy(self)
        result.positions, result.offset = self.positions + self.offset, np.zeros(3)
        result.track = _track_of(result)
        return result

    def covers(self, times: ArrayLike) -> NDArray[np.bool_]:
        """Return for which of the `times` [..] [s] there is a pose.

        There is one between two poses that are at most `longest_gap` apart, and within `POSE_TOLERANCE` of any pose.
        """
        t = np.asarray(times, float)
        before, after = self._neighbours(t)
        since, until = t - self.times[before], self.times[after] - t
        near = np.minimum(np.abs(since), np.abs(until)) <= POSE_TOLERANCE
        return near | ((since >= 0) & (until >= 0) & (since + until <= self.longest_gap))

    def widest_spacing(self, start: float, stop: float) -> float:
        """Return the longest time between neighbouring poses from `start` to `stop` [s], infinite if not covered."""
        if not self.covers([start, stop]).all() or len(self.times) < 2:
            return np.inf
        first = min(int(self._neighbours(np.asarray(start))[0]), len(self.times) - 2)
        last = max(int(self._neighbours(np.asarray(stop))[1]), first + 1)
        return float(np.diff(self.times[first : last + 1]).max())

    def interpolate(self, times: ArrayLike) -> Pose:
        """Return the poses at `times` [s], shape [n] or scalar.

        Raises:
            ValueError: there is no pose at one of the times.
        """
        t = np.asarray(times, float)
        if not self.covers(t).all():
            raise ValueError(f"no recorded pose at {t} s; the poses run from {self.times[0]} to {self.times[-1]} s")
        velocity = np.stack([np.interp(t, self.times, axis) for axis in self.velocities.T], axis=-1)
        return Pose(*self.track.interpolate(t), velocity)

    def _neighbours(self, t: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the indices of the poses before and after the times."""
        last = len(self.times) - 1
        before = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, last)
        return before, np.minimum(before + 1, last)


def sort_poses(
    times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike
) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """Return poses in the order of their times, each time once, with unit quaternions.

    Args:
        times: [n]; of equal times the last one is used.
        positions: [n, 3].
        quaternions: [n, 4].

    Returns:
        The indices of the chosen poses [m], their times [m], positions [m, 3] and quaternions [m, 4].
    """
    t, p = np.asarray(times, float), np.asarray(positions, float).reshape(-1, 3)
    q = np.asarray(quaternions, float).reshape(-1, 4)
    order = np.argsort(t, kind="stable")
    order = order[np.append(np.diff(t[order]) > 0, True)]
    return order, t[order], p[order], q[order] / np.linalg.norm(q[order], axis=1, keepdims=True)


def position_differences(times: Array, positions: Array) -> Array:
    """Return (p(t + h) - p(t - h)) / 2 h [n, 3], one-sided at the ends.

    h is the median time between poses, but at least 0.05 s.
    """
    if len(times) < 2:
        return np.zeros_like(positions)
    half = max(float(np.median(np.diff(times))), MIN_DIFFERENCE_TIME)
    early, late = np.maximum(times - half, times[0]), np.minimum(times + half, times[-1])
    moved = [np.interp(late, times, axis) - np.interp(early, times, axis) for axis in positions.T]
    return np.stack(moved, axis=1) / np.maximum(late - early, 1e-9)[:, None]


def _track_of(poses: RecordedPoses) -> PoseTrack:
    # Extrapolated poses at either end let the track serve the times within the tolerance, too.
    t, p, q, reach = poses.times, poses.positions, poses.quaternions, POSE_TOLERANCE * poses.velocities
    return PoseTrack.from_arrays(
        np.concatenate([t[:1] - POSE_TOLERANCE, t, t[-1:] + POSE_TOLERANCE]),
        np.concatenate([p[:1] - reach[:1], p, p[-1:] + reach[-1:]]),
        np.concatenate([q[:1], q, q[-1:]]),
    )
