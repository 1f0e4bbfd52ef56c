"""The last sweeps of a LiDAR as one cloud in the world: each point placed by the pose at its own time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.quaternions import rotate

__all__ = ["SweepBuffer"]


@dataclass(frozen=True, eq=False)
class _Chunk:
    """Points that came together."""

    points: NDArray[np.float32]
    newest: float


class SweepBuffer:
    """Points of the last `sweeps` x `period` seconds, deskewed.

    Between two poses the position is interpolated linearly and the attitude along the shortest arc. Points newer than
    the newest pose wait for the next one; those older than the oldest pose, or between two poses too far apart to
    interpolate, are dropped and counted. Memory is bounded whatever comes. May be used from several threads.

    Args:
        sweeps: number of sweeps.
        period: time of one [s].
        capacity: most points that are kept, and most that wait for a pose; the oldest go first.
        mount_position: of the sensor [m], shape [3], body frame.
        mount_quaternion: sensor to body, w x y z, unit, shape [4].
        max_gap: longest time between two poses that is bridged [s].
        clock: host time [s], for ages.

    Raises:
        ValueError: an option is out of range.

    Attributes:
        dropped: number of points that could not be placed, or for which there was no room.
    """

    def __init__(
        self,
        sweeps: int = 10,
        period: float = 0.1,
        capacity: int = 200_000,
        *,
        mount_position: ArrayLike = (0.0, 0.0, 0.0),
        mount_quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        max_gap: float = 0.25,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        for name, value in (("sweeps", sweeps), ("period", period), ("capacity", capacity), ("max_gap", max_gap)):
            if not value > 0:
                raise ValueError(f"{name} of the sweep buffer is {value!r}; it must be positive.")
        self.dropped = 0
        self._window = sweeps * period
        self._capacity = int(capacity)
        columns = [rotate(mount_quaternion, axis) for axis in np.eye(3)]
        self._mount = np.column_stack([*columns, np.asarray(mount_position, dtype=np.float64)]).astype(np.float32)
        self._max_gap = max_gap
        self._clock = clock
        self._poses = _Poses()
        self._chunks: deque[_Chunk] = deque()
        self._count = 0
        self._newest = -np.inf
        self._waiting: deque[tuple[NDArray[np.float32], NDArray[np.float64]]] = deque()
        self._waiting_count = 0
        self._lock = threading.Lock()

    def add_pose(self, time: float, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Say where the body was; poses not newer than the last one are ignored.

        Args:
            time: host time [s].
            position: [m], shape [3], world frame.
            quaternion: body to world, w x y z, unit, shape [4].
        """
        with self._lock:
            if self._poses.add(time, position, quaternion):
                self._place_waiting()

    def add_points(self, points_sensor: ArrayLike, times: ArrayLike) -> None:
        """Take in points [m], shape [n, 3], sensor frame, measured at the host times [s], shape [n]."""
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
        """Forget every pose and point: places from now on do not go together with those before."""
        with self._lock:
            self.dropped += self._waiting_count
            self._poses = _Poses()
            self._chunks.clear()
            self._waiting.clear()
            self._count = self._waiting_count = 0
            self._newest = -np.inf

    def cloud(self, now: float | None = None) -> tuple[NDArray[np.float32], float]:
        """Return the points [m], shape [P, 3], world frame, oldest first, and the age of the newest [s].

        The age is infinite while there has been no point. The array is the caller's own.

        Args:
            now: host time [s]; None asks the clock.
        """
        with self._lock:
            chunks, newest = [chunk.points for chunk in self._chunks], self._newest
        points = np.concatenate(chunks) if chunks else np.zeros((0, 3), dtype=np.float32)
        return points, (self._clock() if now is None else now) - newest

    def _place_waiting(self) -> None:
        newest = self._poses.newest
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
        placed, known = self._poses.place(points, times, self._mount, self._max_gap)
        if not known.all():
            self.dropped += int(len(known) - known.sum())
            placed, times = placed[known], times[known]
        if len(placed) > 0:
            self._keep(_Chunk(placed, float(times.max())))

    def _keep(self, chunk: _Chunk) -> None:
        self._chunks.append(chunk)
        self._count += len(chunk.points)
        self._newest = max(self._newest, chunk.newest)
        # The newest chunk always stays: it is never larger than the capacity.
        while self._count > self._capacity or self._chunks[0].newest < self._newest - self._window:
            self._count -= len(self._chunks.popleft().points)


class _Poses:
    """The last poses, in order of time."""

    COUNT = 512  # 5 s at 100 Hz

    def __init__(self) -> None:
        self._rows = np.zeros((2 * self.COUNT, 8))
        self._first = self._end = 0

    @property
    def newest(self) -> float:
        """Time of the last pose [s]; -inf without any."""
        return float(self._rows[self._end - 1, 0]) if self._end else -np.inf

    def add(self, time: float, position: ArrayLike, quaternion: ArrayLike) -> bool:
        """Take in a pose; return whether it is newer than the others."""
        if not time > self.newest:
            return False
        if self._end == len(self._rows):
            self._rows[: self.COUNT - 1] = self._rows[-self.COUNT + 1 :]
            self._first, self._end = 0, self.COUNT - 1
        row = self._rows[self._end]
        row[0], row[1:4], row[4:] = time, position, quaternion
        # Both signs are the same attitude; the interpolation wants neighbours on one side.
        if self._end > self._first and row[4:] @ self._rows[self._end - 1, 4:] < 0.0:
            row[4:] *= -1.0
        self._end += 1
        self._first = max(self._first, self._end - self.COUNT)
        return True

    def place(
        self, points: NDArray[np.float32], times: NDArray[np.float64], mount: NDArray[np.float32], max_gap: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return points in the world [n, 3] and whether their pose is known [n], for times [n] up to the newest.

        Args:
            points: sensor frame [m], [n, 3].
            times: [s], [n].
            mount: sensor to body, rotation and translation, [3, 4].
            max_gap: longest time between two poses that is bridged [s].
        """
        rows = self._rows[self._first : self._end]
        if len(rows) == 1:
            rows = np.repeat(rows, 2, axis=0)  # a point at the very time of the only pose
            rows[0, 0] -= 1e-3
        before = np.clip(np.searchsorted(rows[:, 0], times, side="left") - 1, 0, len(rows) - 2)
        # What depends on a pair of poses is computed once per pair, of which there are few.
        first, last = int(before.min()), int(before.max())
        rows, before = rows[first : last + 2], before - first
        gap = np.diff(rows[:, 0])
        share = (times - rows[before, 0]) / gap[before]
        known = (share >= 0.0) & (gap[before] <= max_gap)
        # q(s) = (sin((1 - s) a) q_0 + sin(s a) q_1) / sin a; for small angles a the weights are 1 - s and s.
        angle = np.arccos(np.clip(np.einsum("ij,ij->i", rows[:-1, 4:], rows[1:, 4:]), -1.0, 1.0))
        near = angle < 1e-3
        table = np.column_stack([rows[:-1, 1:], np.diff(rows[:, 1:4], axis=0), rows[1:, 4:], angle, np.sin(angle)])
        px, py, pz, w0, x0, y0, z0, dx, dy, dz, w1, x1, y1, z1, turn, sine = table.astype(np.float32).T[:, before]
        s = share.astype(np.float32)
        if near.all():
            a, b = 1.0 - s, s
        else:
            sine[near[before]] = np.inf
            a, b = np.sin((1.0 - s) * turn) / sine, np.sin(s * turn) / sine
            a[near[before]], b[near[before]] = 1.0 - s[near[before]], s[near[before]]
        w, x, y, z = a * w0 + b * w1, a * x0 + b * x1, a * y0 + b * y1, a * z0 + b * z1
        # v' = v + w t + u x t with t = 2 u x v
        vx, vy, vz = mount[:, :3] @ points.T + mount[:, 3:]
        tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
        placed = np.empty((len(times), 3), dtype=np.float32)
        placed[:, 0] = vx + w * tx + (y * tz - z * ty) + (px + s * dx)
        placed[:, 1] = vy + w * ty + (z * tx - x * tz) + (py + s * dy)
        placed[:, 2] = vz + w * tz + (x * ty - y * tx) + (pz + s * dz)
        return placed, known
