"""Where the vehicle was: recorded poses as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.quaternions import rotate, slerp

__all__ = ["POSE_TOLERANCE", "Pose", "PoseTrack"]

POSE_TOLERANCE = 0.1
"""A pose answers for times up to this far outside the track [s], at constant velocity: one sweep of a 10 Hz LiDAR."""

_LONGEST_GAP = 1.0
_SLOWEST_DIFFERENCE = 0.05


class Pose(NamedTuple):
    """Poses at n times (or one, without the leading axis)."""

    position: NDArray[np.float64]
    """[m], shape [n, 3], world, relative to the track's offset."""
    quaternion: NDArray[np.float64]
    """w, x, y, z, body to world, shape [n, 4]."""
    velocity: NDArray[np.float64]
    """[m/s], shape [n, 3], world."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Recorded poses of the body; between two of them position is linear in time and orientation is slerped."""

    times: NDArray[np.float64]
    """[s] from the recording's first playable sweep, increasing, shape [n]."""
    positions: NDArray[np.float64]
    """[m], shape [n, 3], world, minus `offset`: small numbers, so that float32 keeps millimetres."""
    quaternions: NDArray[np.float64]
    """w, x, y, z, body to world, shape [n, 4]."""
    velocities: NDArray[np.float64]
    """[m/s], shape [n, 3], world."""
    offset: NDArray[np.float64]
    """First recorded position [m], shape [3]; recorded position = position + offset."""
    measured_velocity: bool
    """True when the velocities were recorded, False when they are differences of positions."""

    @staticmethod
    def build(times: ArrayLike, positions: ArrayLike, quaternions: ArrayLike,
              body_velocities: ArrayLike | None = None) -> PoseTrack:  # fmt: skip
        """Return the track of n >= 1 valid poses in any order; of equal times the last one counts.

        `body_velocities` [m/s] (n, 3), in the body frame as in a nav_msgs/Odometry twist, are used unless all zero
        (many odometries leave them unset) or not finite; otherwise velocities are central differences of the
        positions over at least 0.05 s on either side, which keeps the noise of fast pose estimates small.
        """
        t, p = np.asarray(times, float), np.asarray(positions, float).reshape(-1, 3)
        q = np.asarray(quaternions, float).reshape(-1, 4)
        order = np.argsort(t, kind="stable")
        order = order[np.append(np.diff(t[order]) > 0, True)]
        t, p, q = t[order], p[order], q[order] / np.linalg.norm(q[order], axis=1, keepdims=True)
        offset = p[0].copy()
        p = p - offset
        velocities, measured = _differences(t, p), False
        if body_velocities is not None:
            twist = np.asarray(body_velocities, float).reshape(-1, 3)[order]
            if np.isfinite(twist).all() and twist.any():
                velocities, measured = rotate(q, twist), True
        return PoseTrack(t, p, q, velocities, offset, measured)

    def shifted(self, start: float) -> PoseTrack:
        """Return the same track with times counted from `start` [s]."""
        return PoseTrack(self.times - start, self.positions, self.quaternions, self.velocities, self.offset,
                         self.measured_velocity)  # fmt: skip

    @property
    def longest_gap(self) -> float:
        """Poses farther apart than this [s] do not answer for the time between them."""
        if len(self.times) < 2:
            return _LONGEST_GAP
        return max(_LONGEST_GAP, 3.0 * float(np.median(np.diff(self.times))))

    def covers(self, times: ArrayLike) -> NDArray[np.bool_]:
        """Return where the track answers: inside it or within `POSE_TOLERANCE` of a pose, and not in a long gap."""
        t = np.asarray(times, float)
        before, after = self._neighbours(t)
        since, until = t - self.times[before], self.times[after] - t
        near = np.minimum(np.abs(since), np.abs(until)) <= POSE_TOLERANCE
        return near | ((since >= 0) & (until >= 0) & (since + until <= self.longest_gap))

    def widest_spacing(self, start: float, stop: float) -> float:
        """Return the largest distance in time [s] of the poses around [start, stop]; infinite off the track."""
        if not self.covers([start, stop]).all() or len(self.times) < 2:
            return np.inf
        first = int(self._neighbours(np.asarray(start))[0])
        last = max(int(self._neighbours(np.asarray(stop))[1]), first + 1)
        if last >= len(self.times):
            first, last = len(self.times) - 2, len(self.times) - 1
        return float(np.diff(self.times[first : last + 1]).max())

    def at(self, times: ArrayLike) -> Pose:
        """Return the poses at `times` [s], shape [n] or a scalar; raises ValueError where the track has none."""
        t = np.asarray(times, float)
        if not self.covers(t).all():
            raise ValueError(f"no recorded pose at {t} s; the track runs from {self.times[0]} to {self.times[-1]} s")
        i, j = self._neighbours(t)
        span = self.times[j] - self.times[i]
        fraction = np.clip((t - self.times[i]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
        f = fraction[..., None]
        velocity = (1.0 - f) * self.velocities[i] + f * self.velocities[j]
        beyond = t - np.clip(t, self.times[0], self.times[-1])
        position = (1.0 - f) * self.positions[i] + f * self.positions[j] + beyond[..., None] * velocity
        return Pose(position, slerp(self.quaternions[i], self.quaternions[j], fraction), velocity)

    def _neighbours(self, t: NDArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        last = len(self.times) - 1
        before = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, last)
        return before, np.minimum(before + 1, last)


def _differences(times: NDArray, positions: NDArray) -> NDArray[np.float64]:
    """Return (p(t + h) - p(t - h)) / 2 h, one-sided at the ends, with h the median period but at least 0.05 s."""
    if len(times) < 2:
        return np.zeros_like(positions)
    half = max(float(np.median(np.diff(times))), _SLOWEST_DIFFERENCE)
    early, late = np.maximum(times - half, times[0]), np.minimum(times + half, times[-1])
    moved = [np.interp(late, times, axis) - np.interp(early, times, axis) for axis in positions.T]
    return np.stack(moved, axis=1) / np.maximum(late - early, 1e-9)[:, None]
