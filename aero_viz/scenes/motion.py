"""Motion of cylinders: back and forth along a horizontal line, at a constant speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SPEED_MAX = 100.0
"""Largest speed of an obstacle [m/s]."""


def displacements(motion: NDArray[np.float64], time: ArrayLike) -> NDArray[np.float64]:
    """Return how far cylinders are from their places at time 0 [m], [.., n, 2]: a triangle wave along the velocity.

    Args:
        motion: rows of `World.motion`, [n, 3].
        time: [s], any shape [..]; may be negative.
    """
    velocity, span = motion[:, :2], motion[:, 2]
    speed = np.linalg.norm(velocity, axis=1)
    moves = speed > 0.0
    direction = velocity / np.where(moves, speed, 1.0)[:, None]
    period = np.where(moves, 2.0 * span, 1.0)
    travelled = np.mod(np.asarray(time, dtype=np.float64)[..., None] * speed, period)
    return np.minimum(travelled, period - travelled)[..., None] * direction


def check_motion(motion: NDArray[np.float64], cylinders: int) -> None:
    """Refuse a table that does not fit the number of cylinders, or has a row that is out of range.

    Raises:
        ValueError: the message names the row.
    """
    if len(motion) != cylinders:
        raise ValueError(
            f'"motion" has {len(motion)} rows for {cylinders} cylinders; give one row (vx, vy, span) per cylinder, '
            "0, 0, 0 for a static one."
        )
    for row, (x, y, span) in enumerate(motion):
        speed = np.hypot(x, y)
        if speed > SPEED_MAX:
            raise ValueError(f'"motion" row {row} has a speed of {speed:g} m/s; it must be at most {SPEED_MAX:g} m/s.')
        if span < 0.0 or (span == 0.0 and speed > 0.0):
            raise ValueError(
                f'"motion" row {row} has span = {span:g}; it must be the distance after which the cylinder turns back, '
                "greater than 0 m."
            )
