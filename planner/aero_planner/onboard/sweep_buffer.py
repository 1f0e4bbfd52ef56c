"""The last sweeps of a LiDAR as one cloud in the world frame, each point moved by the pose at its own time."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.settings import OnboardConfig
from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import quaternion_from_angles, rotation_matrix
from aero_planner.sweeps import Arrival, Sweeps

_POSES = 512
"""Poses that are kept: 5 s at 100 Hz."""
_COMPARED_SWEEPS = 2
"""Sweeps that are compared with as many before: with more, a drone in flight sees other surfaces in the second part."""


class SweepBuffer:
    """The deskewed points of the last `sweeps` x `period` seconds, and thinned points from before. Thread-safe.

    Points newer than the newest pose wait for the next one. Points that are older than the oldest pose, or that lie
    between two poses too far apart to interpolate, are dropped and counted. Memory is bounded for any input.

    Args:
        sweeps: Number of newest sweeps, of which all points are in the cloud.
        period: Duration of a sweep [s].
        capacity: Largest number of their points, and of points that wait for a pose; the oldest are dropped.
        older_sweeps: Number of sweeps before them, of which the cloud is thinned, see `Sweeps`.
        mount_position: Position of the sensor in the body frame [m], shape [3].
        mount_quaternion: Sensor to body, w x y z, unit, shape [4].
        max_gap: Longest time between two poses that is interpolated [s].

    Raises:
        ValueError: An option is out of range.

    Attributes:
        dropped: Number of points that could not be placed, or for which there was no room.
    """

    def __init__(
        self,
        sweeps: int = 10,
        period: float = 0.1,
        capacity: int = 200_000,
        *,
        older_sweeps: int = 0,
        mount_position: ArrayLike = (0.0, 0.0, 0.0),
        mount_quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        max_gap: float = 0.25,
    ) -> None:
        for name, value in (("sweeps", sweeps), ("period", period), ("capacity", capacity), ("max_gap", max_gap)):
            if not value > 0:
                raise ValueError(f"{name} of the sweep buffer is {value!r}; it must be positive.")
        self.dropped = 0
        self._period, self._window = period, sweeps * period
        self._older_window = older_sweeps * period
        self._capacity = int(capacity)
        self._older_capacity = self._capacity * older_sweeps // sweeps
        position = np.asarray(mount_position, dtype=np.float64)
        self._mount = np.column_stack([rotation_matrix(mount_quaternion), position]).astype(np.float32)
        self._max_gap = max_gap
        self._poses = PoseTrack(_POSES)
        # Points that were placed together, world frame [m], shape [n, 3], and when the newest was measured [s].
        self._chunks: deque[tuple[NDArray[np.float32], float]] = deque()
        self._older: deque[tuple[NDArray[np.float32], float]] = deque()
        self._older_count = 0
        self._unread = 0  # newest chunks that `cloud` has not returned yet
        self._count = 0
        self._newest = -np.inf
        self._waiting: deque[tuple[NDArray[np.float32], NDArray[np.float64]]] = deque()
        self._waiting_count = 0
        self._lock = threading.Lock()

    def add_pose(self, time: float, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Add a pose of the body. Poses that are not newer than the last one are ignored.

        Args:
            time: Host time [s].
            position: World frame [m], shape [3].
            quaternion: Body to world, w x y z, unit, shape [4].
        """
        with self._lock:
            if self._poses.append(time, position, quaternion):
                self._place_waiting()

    def add_points(self, points_sensor: ArrayLike, times: ArrayLike) -> None:
        """Add points.

        Args:
            points_sensor: Sensor frame [m], shape [n, 3].
            times: When each was measured, host time [s], shape [n].
        """
        points = np.asarray(points_sensor, dtype=np.float32)
        stamps = np.asarray(times, dtype=np.float64)
        if len(points) == 0:
            return
        with self._lock:
            self._waiting.append((points[-self._capacity :], stamps[-self._capacity :]))
            self._waiting_count += len(self._waiting[-1][0])
            self.dropped += len(points) - len(self._waiting[-1][0])
            while self._waiting_count > self._capacity:
                oldest, _ = self._waiting.popleft()
                self._waiting_count -= len(oldest)
                self.dropped += len(oldest)
            self._place_waiting()

    def clear(self) -> None:
        """Discard every pose and point, because the origin of the world frame has moved."""
        with self._lock:
            self.dropped += self._waiting_count
            self._poses = PoseTrack(_POSES)
            self._chunks.clear()
            self._older.clear()
            self._waiting.clear()
            self._count = self._older_count = self._unread = self._waiting_count = 0
            self._newest = -np.inf

    @property
    def waiting(self) -> int:
        """Number of points that wait for a pose."""
        return self._waiting_count

    def cloud(self, now: float) -> tuple[Sweeps, float]:
        """Return the points in the world frame, oldest first, and the age of the newest at `now` [s].

        Points that were placed since the last call form one of the sweeps. The age is infinite before the first point.
        """
        with self._lock:
            placed = [self._chunks.pop() for _ in range(self._unread)][::-1]
            if placed:
                points = np.concatenate([points for points, _ in placed])
                points.flags.writeable = False
                self._chunks.append((points, max(time for _, time in placed)))
            self._unread = 0
            chunks = [points for points, _ in (*self._older, *self._chunks)]
            arrivals = [None] * len(self._older) + self._arrivals()
            return Sweeps(chunks, whole=len(self._chunks), arrivals=arrivals), now - self._newest

    def _arrivals(self) -> list[Arrival]:
        """Return the time of the newest point of each chunk, and the position from which it was measured."""
        if not self._chunks:
            return []
        times = [time for _, time in self._chunks]
        positions, _ = self._poses.interpolate(times)
        return [Arrival(time, (x, y, z)) for time, (x, y, z) in zip(times, positions.tolist(), strict=True)]

    def newest_pair(self) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """Return the points of the two sweeps before the newest two, and of these [m], and the time between them [s].

        Both have shape [n, 3], world frame.
        """
        interval = _COMPARED_SWEEPS * self._period
        with self._lock:
            older, newer = (
                [points for points, time in self._chunks if 0.0 <= (self._newest - time) / interval - k < 1.0]
                for k in (1, 0)
            )
        none = np.zeros((0, 3), dtype=np.float32)
        return np.concatenate(older) if older else none, np.concatenate(newer) if newer else none, interval

    def _place_waiting(self) -> None:
        newest = self._poses.newest_time
        if not self._waiting or not np.isfinite(newest):
            return
        parts = list(self._waiting)
        points = np.concatenate([part for part, _ in parts]) if len(parts) > 1 else parts[0][0]
        times = np.concatenate([part for _, part in parts]) if len(parts) > 1 else parts[0][1]
        later = times > newest
        self._waiting.clear()
        self._waiting_count = int(later.sum())
        if self._waiting_count:
            self._waiting.append((points[later], times[later]))
            points, times = points[~later], times[~later]
        if len(points) == 0:
            return
        placed, known = self._poses.deskew(points, times, mount=self._mount, max_gap=self._max_gap)
        if not known.all():
            self.dropped += int(len(known) - known.sum())
            placed, times = placed[known], times[known]
        if len(placed) > 0:
            self._keep(placed, float(times.max()))

    def _keep(self, points: NDArray[np.float32], time: float) -> None:
        self._chunks.append((points, time))
        self._unread += 1
        self._count += len(points)
        self._newest = max(self._newest, time)
        # The newest chunk always stays: it is never larger than the capacity.
        while self._count > self._capacity or self._chunks[0][1] < self._newest - self._window:
            oldest = self._chunks.popleft()
            self._count -= len(oldest[0])
            self._older_count += len(oldest[0])
            self._older.append(oldest)
        self._unread = min(self._unread, len(self._chunks))
        first = self._newest - self._window - self._older_window
        while self._older and (self._older_count > self._older_capacity or self._older[0][1] < first):
            self._older_count -= len(self._older.popleft()[0])


def make_sweep_buffer(config: OnboardConfig) -> SweepBuffer:
    """Return an empty sweep buffer for the LiDAR as it is mounted."""
    lidar, (position, quaternion) = config.lidar, lidar_mount(config)
    return SweepBuffer(
        lidar.sweeps,
        lidar.sweep_period,
        lidar.points_max,
        older_sweeps=lidar.older_sweeps,
        mount_position=position,
        mount_quaternion=quaternion,
    )


def lidar_mount(config: OnboardConfig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position [m], [3], and attitude, w x y z, of the LiDAR in the body frame."""
    lidar = config.lidar
    position = np.array([lidar.mount_x, lidar.mount_y, lidar.mount_z])
    return position, quaternion_from_angles(lidar.mount_roll, lidar.mount_pitch, lidar.mount_yaw)
