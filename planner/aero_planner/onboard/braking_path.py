"""A path on which the drone comes to rest away from obstacles, found by the planner from the last known cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.plan import Plan

Array = NDArray[np.float64]

PATH_POINTS = 32
"""Largest number of points of a path."""
_REACH = 1.0
"""Distance from the path beyond which it is not followed [m]."""


@dataclass(frozen=True)
class PathState:
    """Desired motion at one place of a path, world frame."""

    position: Array
    """[m], shape [3]."""
    velocity: Array
    """[m/s], shape [3]."""
    acceleration: Array
    """[m/s^2], shape [3]."""


@dataclass(frozen=True, eq=False)
class BrakingPath:
    """Motion of a braking drone at equal time steps, world frame."""

    period: float
    """Time between two points [s]."""
    positions: Array
    """[m], shape [n, 3], 2 <= n <= `PATH_POINTS`."""
    velocities: Array
    """[m/s], shape [n, 3]."""

    def near(self, position: Array, lead: float) -> PathState | None:
        """Return the desired motion at the place nearest to `position` [m]; None if the path is too far away.

        Past the end, it is rest at the end point. The acceleration is that of `lead` [s] later, because the drone must
        first turn to it.
        """
        distances = np.linalg.norm(self.positions - position, axis=1)
        i = int(distances.argmin())
        if distances[i] > _REACH:
            return None
        last = len(self.positions) - 1
        # The place between two points, by projection onto the segment in the direction of the drone.
        i = max(i - 1, 0) if i == last or self._along(i, position) < 0.0 else i
        share = min(max(self._along(i, position), 0.0), 1.0)
        p, v = (values[i] + share * (values[i + 1] - values[i]) for values in (self.positions, self.velocities))
        if i + share >= last:
            return PathState(self.positions[-1], np.zeros(3), np.zeros(3))
        ahead = int(i + share + lead / self.period)
        a = (self.velocities[ahead + 1] - self.velocities[ahead]) / self.period if ahead < last else np.zeros(3)
        return PathState(p, v, a)

    def _along(self, i: int, position: Array) -> float:
        """Return the place of `position` along the segment from point i to the next one, 0 to 1 within it."""
        segment = self.positions[i + 1] - self.positions[i]
        return float((position - self.positions[i]) @ segment / max(float(segment @ segment), 1e-9))


def choose_path(plan: Plan, dt: float) -> BrakingPath | None:
    """Return the braking candidate of a plan with the largest clearance; of several, the one nearest to straight ahead.

    Args:
        plan: A plan for one drone.
        dt: Its time step [s].
    """
    if plan.braking is None:
        return None
    candidate = int(np.argmax(plan.braking.clearance))
    positions, velocities = plan.braking.positions[candidate], plan.braking.velocities[candidate]
    stride = -(-len(positions) // PATH_POINTS)
    path = BrakingPath(stride * dt, positions[::stride].astype(np.float64), velocities[::stride].astype(np.float64))
    return path if np.isfinite(path.positions).all() and np.isfinite(path.velocities).all() else None
