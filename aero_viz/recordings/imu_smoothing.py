"""Smoothing of registered poses by an IMU: slow motion from the LiDAR, fast motion from the IMU."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import conjugate, multiply, rotate, rotation_vector
from aero_viz.recordings.imu import ImuSamples
from aero_viz.recordings.transforms import Transform

Array = NDArray[np.float64]

_WINDOW = 1.0
"""Registered poses within this time of a pose correct its IMU motion [s]."""
_MIN_POSES = 5
"""A window with fewer poses is not smoothed: it could not tell noise from motion."""
_MAX_GAP = 0.05
"""Longest time between two samples of the IMU [s]."""


def smooth_motion(
    times: Array, positions: Array, quaternions: Array, imu: ImuSamples, mount: Transform, start: int
) -> tuple[Array, Array]:
    """Return positions [n, 3] [m] and attitudes [n, 4] without the noise of single registrations.

    The IMU's rates and forces are integrated from pose to pose. The difference between this motion and the registered
    poses varies slowly, with the errors of the integration; it is fitted in a moving window by a straight line for the
    attitude and a parabola for the position, which also absorb a constant bias of the IMU.

    Args:
        times: [n] [s] after `start`, ascending.
        positions: of the registered poses [n, 3] [m], z up.
        quaternions: body to world [n, 4].
        imu: samples; if they do not cover the poses without gaps, the poses are returned as they are.
        mount: pose of the IMU in the body's frame; its distance from the body's origin is neglected.
        start: stamp of time zero [ns].
    """
    stamps = (imu.times - start) * 1e-9
    inside = slice(max(int(np.searchsorted(stamps, times[0])) - 1, 0), int(np.searchsorted(stamps, times[-1])) + 1)
    stamps = stamps[inside]
    covers = len(stamps) > 2 and stamps[0] <= times[0] + _MAX_GAP and stamps[-1] >= times[-1] - _MAX_GAP
    if len(times) < _MIN_POSES or not covers or np.diff(stamps).max() > _MAX_GAP:
        return positions, quaternions
    rates, forces = (rotate(mount.quaternion, values[inside]) for values in (imu.rates, imu.forces))
    # A fine grid that holds all poses, with the mean of the samples in every step.
    grid = np.unique(np.concatenate([times, stamps[(stamps > times[0]) & (stamps < times[-1])]]))
    steps, middle = np.diff(grid), 0.5 * (grid[1:] + grid[:-1])
    at = np.searchsorted(grid, times)
    rate, force = (
        np.stack([np.interp(middle, stamps, column) for column in values.T], axis=1) for values in (rates, forces)
    )
    turns = _turn(rate * steps[:, None])
    attitude = np.empty((len(grid), 4))
    attitude[0] = quaternions[0]
    for i, turn in enumerate(turns):
        attitude[i + 1] = multiply(attitude[i], turn)
    errors = multiply(quaternions, conjugate(attitude[at]))
    attitude = multiply(_fit_turns(times, errors, grid), attitude)
    specific = rotate(multiply(attitude[:-1], _turn(0.5 * rate * steps[:, None])), force)
    velocity = np.concatenate([np.zeros((1, 3)), np.cumsum(specific * steps[:, None], axis=0)])
    moved = (velocity[:-1] + 0.5 * specific * steps[:, None]) * steps[:, None]
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    path -= np.outer(0.5 * (grid - grid[0]) ** 2, [0.0, 0.0, _gravity(specific)])
    correction = _local_fit(times, positions - path[at], times, degree=2)
    return path[at] + correction, attitude[at]


def _turn(vectors: NDArray[np.floating]) -> Array:
    """Return the quaternions [n, 4] of rotation vectors [n, 3] [rad]."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vectors], axis=-1)


def _gravity(specific: Array) -> float:
    """Return the mean vertical force [m/s^2]: nearly gravity, and the parabolas absorb the rest."""
    return float(specific[:, 2].mean())


def _fit_turns(times: Array, turns: Array, at: NDArray[np.floating]) -> Array:
    """Return rotations [m, 4] at times `at` from straight lines through the rotations [n, 4] around each of them.

    The lines are in rotation vectors relative to the nearest rotation: within minutes, a biased IMU turns by more than
    half a revolution, beyond which absolute rotation vectors jump.
    """
    nearest = np.searchsorted(0.5 * (times[1:] + times[:-1]), at)
    fitted = np.empty((len(at), 4))
    for i, turn in enumerate(turns):
        first, last = np.searchsorted(times, [times[i] - 2.0 * _WINDOW, times[i] + 2.0 * _WINDOW])
        window = slice(max(first - _MIN_POSES, 0), last + _MIN_POSES)
        vectors = rotation_vector(multiply(turns[window], conjugate(turn)))
        mine = nearest == i
        fitted[mine] = multiply(_turn(_local_fit(times[window], vectors, at[mine], degree=1)), turn)
    return fitted


def _local_fit(times: Array, values: Array, at: NDArray[np.floating], *, degree: int) -> Array:
    """Return values [n, 3] at times `at` [m] from a polynomial in a window around each of them, [m, 3]."""
    fitted = np.empty((len(at), values.shape[1]))
    for i, time in enumerate(at):
        first, last = np.searchsorted(times, [time - _WINDOW, time + _WINDOW])
        if last - first < _MIN_POSES:
            first = int(np.clip(np.searchsorted(times, time) - _MIN_POSES // 2, 0, len(times) - _MIN_POSES))
            last = first + _MIN_POSES
        offsets = times[first:last] - time
        weights = np.maximum(1.0 - (offsets / (1.01 * max(_WINDOW, np.abs(offsets).max()))) ** 2, 0.0)
        powers = offsets[:, None] ** np.arange(degree + 1)
        solution, *_ = np.linalg.lstsq(powers * weights[:, None], values[first:last] * weights[:, None], rcond=None)
        fitted[i] = solution[0]
    return fitted
