"""Distances to the obstacles that a plan knows, without an upper end, and the nearest one: for words and pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import DroneConfig
from aero_planner.plan import MovingObstacles
from aero_planner.stages.moving_obstacles.tracks import GROWTH

Array = NDArray[np.float64]


class Obstacles:
    """The filtered cloud, dynamic obstacles, the ground and the band of heights.

    Args:
        points: filtered cloud [m], shape [P, 3].
        ground_height: [m]; None where it is unknown.
        config: configuration of the planner.
        moving: dynamic obstacles.
    """

    def __init__(
        self,
        points: NDArray[np.float32],
        ground_height: float | None,
        config: DroneConfig,
        moving: MovingObstacles | None = None,
    ) -> None:
        from scipy.spatial import KDTree  # takes 0.1 s to import, which the page need not wait for

        self.points = points
        self._moving = moving
        self._tree = KDTree(points) if len(points) else None
        self._ground = -np.inf if ground_height is None or not config.costs.use_ground else ground_height
        self._band = config.costs.height_min, config.costs.height_max

    def distance(self, positions: Array, times: Array | None = None) -> Array:
        """Return the distance of each position [m], shape [.., 3], to the nearest obstacle [m].

        Args:
            positions: [m], shape [.., 3].
            times: time of each position in the plan [s], which broadcasts to [..]; None leaves out dynamic obstacles.
        """
        height = positions[..., 2]
        level = np.minimum(np.minimum(height - self._band[0], self._band[1] - height), height - self._ground)
        distance = np.minimum(self._nearest(positions)[0], np.maximum(level, 0.0))
        return distance if times is None else np.minimum(distance, self._nearest_moving(positions, times)[0])

    def speed_of_nearest(self, position: Array, time: float) -> float | None:
        """Return the speed of the nearest obstacle at a time in the plan [m/s]; None if it is static."""
        distance, row = self._nearest_moving(position, np.array(time))
        if self._moving is None or distance >= self.distance(position):
            return None
        return float(np.linalg.norm(self._moving.velocities[row]))

    def nearest_point(self, position: Array) -> NDArray[np.float32] | None:
        """Return the nearest point of the cloud [m], shape [3]; None where the ground or the band is nearer."""
        distance, row = self._nearest(position)
        return self.points[int(row)] if np.isfinite(distance) and distance <= self.distance(position) else None

    def _nearest_moving(self, positions: Array, times: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return the distance [m] of each position to the nearest dynamic obstacle, at its time [s], and the row."""
        if self._moving is None or not len(self._moving.radii):
            return np.full(positions.shape[:-1], np.inf), np.zeros(positions.shape[:-1], dtype=np.int64)
        times = np.broadcast_to(times, positions.shape[:-1])[..., None]
        axes = self._moving.positions + times[..., None] * self._moving.velocities
        gaps = np.linalg.norm(positions[..., None, :2] - axes, axis=-1) - self._moving.radii - times * float(GROWTH)
        return np.maximum(gaps.min(axis=-1), 0.0), gaps.argmin(axis=-1)

    def _nearest(self, positions: Array) -> tuple[Array, NDArray[np.int64]]:
        if self._tree is None:
            return np.full(positions.shape[:-1], np.inf), np.zeros(positions.shape[:-1], dtype=np.int64)
        distance, row = self._tree.query(positions)
        return np.asarray(distance), np.asarray(row, dtype=np.int64)
