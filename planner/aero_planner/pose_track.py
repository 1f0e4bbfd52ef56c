"""Poses of a moving body over time: interpolation, and deskewing of the points that it measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.quaternions import slerp

_SMALL_ANGLE = 1e-3
"""Half the angle between two poses [rad] below which the weights of the slerp are linear in float32."""
_LONE_POSE = 1e-3
"""Time before the only pose of a track for which that pose holds [s]."""
_CACHED_POINTS = 16384
"""Points deskewed at once: their intermediate arrays stay in the cache, which takes half the time of whole sweeps."""


class PoseTrack:
    """The newest poses of a body, in the order of their times.

    Between two poses the position is linear in time and the attitude follows the shortest arc (slerp).

    Args:
        capacity: Number of poses that are kept; older ones are dropped.
    """

    def __init__(self, capacity: int = 512) -> None:
        self._capacity = capacity
        # Twice the capacity, so that the newest half is moved to the front only once per `capacity` poses.
        self._rows = np.zeros((2 * capacity, 8))
        self._first = self._end = 0

    @staticmethod
    def from_arrays(times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike) -> PoseTrack:
        """Return the track of all of these poses.

        Args:
            times: [s], shape [n], strictly increasing.
            positions: [m], shape [n, 3].
            quaternions: Body to world, w x y z, unit, shape [n, 4]; of either sign.
        """
        rows = np.column_stack([times, positions, quaternions]).astype(np.float64)
        opposite = np.einsum("ij,ij->i", rows[:-1, 4:], rows[1:, 4:]) < 0.0
        rows[1:, 4:] *= np.where(np.cumsum(opposite) % 2 == 1, -1.0, 1.0)[:, None]
        track = PoseTrack(len(rows))
        track._rows, track._end = rows, len(rows)
        return track

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the poses [s], shape [n], increasing."""
        return self._rows[self._first : self._end, 0]

    @property
    def positions(self) -> NDArray[np.float64]:
        """Positions [m], shape [n, 3]."""
        return self._rows[self._first : self._end, 1:4]

    @property
    def quaternions(self) -> NDArray[np.float64]:
        """Attitudes, body to world, w x y z, shape [n, 4]; neighbours have the same sign."""
        return self._rows[self._first : self._end, 4:]

    @property
    def newest_time(self) -> float:
        """Time of the newest pose [s]; -inf if there is none."""
        return float(self._rows[self._end - 1, 0]) if self._end else -np.inf

    def append(self, time: float, position: ArrayLike, quaternion: ArrayLike) -> bool:
        """Add a pose and return True; return False for one that is not newer than the newest.

        Args:
            time: [s].
            position: [m], shape [3].
            quaternion: Body to world, w x y z, unit, shape [4].
        """
        if not time > self.newest_time:
            return False
        if self._end == len(self._rows):
            kept = self._capacity - 1
            self._rows[:kept] = self._rows[self._end - kept :]
            self._first, self._end = 0, kept
        row = self._rows[self._end]
        row[0], row[1:4], row[4:] = time, position, quaternion
        # Both signs are the same attitude; the interpolation needs neighbours of the same one.
        if self._end > self._first and row[4:] @ self._rows[self._end - 1, 4:] < 0.0:
            row[4:] *= -1.0
        self._end += 1
        self._first = max(self._first, self._end - self._capacity)
        return True

    def interpolate(self, times: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [m], shape [.., 3], and quaternions, shape [.., 4], at `times` [s], shape [..].

        Before the first and after the last pose the result is that pose.

        Raises:
            ValueError: The track has no pose.
        """
        if not len(self):
            raise ValueError("the track has no pose to interpolate.")
        t, own = np.asarray(times, dtype=np.float64), self.times
        before = np.clip(np.searchsorted(own, t, side="right") - 1, 0, len(own) - 1)
        after = np.minimum(before + 1, len(own) - 1)
        span = own[after] - own[before]
        fraction = np.clip((t - own[before]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)
        f = fraction[..., None]
        position = (1.0 - f) * self.positions[before] + f * self.positions[after]
        return position, slerp(self.quaternions[before], self.quaternions[after], fraction)

    def deskew(
        self,
        points: NDArray[np.float32],
        times: NDArray[np.float64],
        *,
        mount: NDArray[np.float32] | None = None,
        max_gap: float = np.inf,
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the points in the world frame [m], shape [n, 3], and whether the pose of each is known, shape [n].

        A point is moved by the pose at its own time. The pose is known between the first and the last pose of the
        track; where it is not, the returned coordinates mean nothing.

        Args:
            points: Sensor frame [m], shape [n, 3].
            times: When each was measured [s], shape [n].
            mount: Sensor to body, rotation and translation [m], shape [3, 4]; None where the sensor is the body.
            max_gap: Longest time between two poses that is interpolated [s].
        """
        if not len(self) or not len(times):
            return np.zeros((len(times), 3), dtype=np.float32), np.zeros(len(times), dtype=np.bool_)
        rows = self._rows[self._first : self._end]
        if len(rows) == 1:
            rows = np.repeat(rows, 2, axis=0)
            rows[0, 0] -= _LONE_POSE
        before = np.clip(np.searchsorted(rows[:, 0], times, side="left") - 1, 0, len(rows) - 2)
        # What depends on a pair of poses is computed once per pair; there are far fewer pairs than points.
        first, last = int(before.min()), int(before.max())
        rows, before = rows[first : last + 2], before - first
        gap = np.diff(rows[:, 0])
        fraction = (times - rows[before, 0]) / gap[before]
        known = (fraction >= 0.0) & (fraction <= 1.0) & (gap[before] <= max_gap)
        s = fraction.astype(np.float32)
        body = points.T if mount is None else mount[:, :3] @ points.T + mount[:, 3:]
        placed = np.empty((len(points), 3), dtype=np.float32)
        for start in range(0, len(points), _CACHED_POINTS):
            part = slice(start, start + _CACHED_POINTS)
            placed[part] = _placed(body[:, part], rows, before[part], s[part])
        return placed, known


def _placed(
    body: NDArray[np.float32], rows: NDArray[np.float64], before: NDArray[np.intp], s: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return points in the world frame [m], shape [n, 3], in float32 arithmetic.

    Args:
        body: Points in the body frame [m], shape [3, n].
        rows: Poses, shape [m, 8]: time, position and quaternion.
        before: Index of the pose before each point, shape [n].
        s: Share of the way from that pose to the next one, shape [n].
    """
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", rows[:-1, 4:], rows[1:, 4:]), -1.0, 1.0))
    small = angle < _SMALL_ANGLE
    table = np.column_stack([rows[:-1, 1:], np.diff(rows[:, 1:4], axis=0), rows[1:, 4:], angle, np.sin(angle)])
    px, py, pz, w0, x0, y0, z0, dx, dy, dz, w1, x1, y1, z1, turn, sine = table.astype(np.float32).T[:, before]
    # q(s) = (sin((1 - s) a) q_0 + sin(s a) q_1) / sin a; for small angles a the weights are 1 - s and s.
    if small.all():
        a, b = 1.0 - s, s
    else:
        sine[small[before]] = np.inf
        a, b = np.sin((1.0 - s) * turn) / sine, np.sin(s * turn) / sine
        a[small[before]], b[small[before]] = 1.0 - s[small[before]], s[small[before]]
    w, x, y, z = a * w0 + b * w1, a * x0 + b * x1, a * y0 + b * y1, a * z0 + b * z1
    # R(q) v = v + w t + u x t with q = (w, u) and t = 2 u x v.
    vx, vy, vz = body
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    placed = np.empty((len(before), 3), dtype=np.float32)
    placed[:, 0] = vx + w * tx + (y * tz - z * ty) + (px + s * dx)
    placed[:, 1] = vy + w * ty + (z * tx - x * tz) + (py + s * dy)
    placed[:, 2] = vz + w * tz + (x * ty - y * tx) + (pz + s * dz)
    return placed
