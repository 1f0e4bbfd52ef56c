"""The point clouds of a batch that the caller has joined, in one device array."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.array_memory import allocate
from aero_planner.arrays import CloudArrays
from aero_planner.kernels.shells import COUNTERS
from aero_planner.sweeps import is_constant

Points = NDArray[Any] | wp.array | Sequence[NDArray[Any]]


class _Sizes(NamedTuple):
    B: int
    S: int = 1
    P: int = 1
    E: int = int(COUNTERS)


class Cloud:
    """Point clouds of B drones in one device array.

    Args:
        batch: B, or None for one drone whose cloud has no leading axis.
        point_count: number of points of each drone, int [B].

    Attributes:
        arrays: the cloud as one sweep, whose points are not ordered; NaN where no point was written yet.
    """

    def __init__(self, batch: int | None, point_count: wp.array) -> None:
        self._batched = batch is not None
        self._batch = batch or 1
        self._device = device = wp.get_device(str(point_count.device))
        self._written: Any = None
        count = wp.array(ptr=point_count.ptr, dtype=int, shape=(self._batch, 1), device=device)
        arrays = allocate(CloudArrays, _Sizes(self._batch), device)
        self.arrays = dataclasses.replace(arrays, points=self._new_array(1), count=count)

    @property
    def array(self) -> wp.array:
        """Shape [B, P], vec3 [m], world frame."""
        return self.arrays.points

    @property
    def capacity(self) -> int:
        """P, the largest number of points of a drone."""
        return self.array.shape[1]

    def invalidate(self) -> None:
        """Make `is_current` false until the next `write`: the caller may have changed the array."""
        self._written = None

    def reserve(self, count: int) -> bool:
        """Make room for `count` points per drone, all NaN; return True if the array was replaced."""
        self._written = None
        if count == self.capacity:
            self.array.fill_(wp.vec3(np.nan))
            return False
        self.arrays = dataclasses.replace(self.arrays, points=self._new_array(max(count, 1)))
        return True

    def _new_array(self, count: int) -> wp.array:
        return wp.full((self._batch, count), wp.vec3(np.nan), dtype=wp.vec3, device=self._device)

    def is_current(self, points: Points) -> bool:
        """Return True if the array already holds `points`: they are this array, or a read-only array written last."""
        return points is self.array or (self._written is not None and self._written is points)

    def write(self, points: Points, clouds: list[Any]) -> list[int]:
        """Copy `clouds`, the result of `split` for `points`, to the device; the array grows if needed.

        Returns:
            The number of points of each.
        """
        counts = [len(cloud) for cloud in clouds]
        if max(counts) > self.capacity:
            # Some room to grow: a cloud that gains a few points with each sweep must not rebuild the graph each time.
            self.reserve(max(counts) * 5 // 4)
        for b, cloud in enumerate(clouds):
            row: Any = self.array[b]
            if isinstance(cloud, wp.array):
                wp.copy(row, cloud, count=len(cloud))
            elif self._device.is_cpu:
                with np.errstate(over="ignore"):  # infinite points are dropped
                    self.array.numpy()[b, : len(cloud)] = cloud
            else:
                source = wp.array(
                    np.ascontiguousarray(cloud, dtype=np.float32), dtype=wp.vec3, device="cpu", copy=False
                )
                wp.copy(row, source, count=len(cloud))
        self._written = points if is_constant(points) else None
        return counts

    def split(self, points: Points) -> list[Any]:
        """Return the cloud of each drone; of the array itself, that on the device.

        Raises:
            ValueError: the number of clouds differs from the batch, or a cloud has the wrong shape or type.
        """
        if points is self.array:
            return [self.array[b] for b in range(self._batch)]
        if isinstance(points, wp.array):
            if points.dtype is not wp.vec3:
                raise ValueError(f"points has dtype {points.dtype}; a Warp array must have dtype wp.vec3.")
            expected = 2 if self._batched else 1
            if points.ndim != expected:
                raise ValueError(f"points has {points.ndim} dimensions of wp.vec3; it must have {expected}.")
            clouds = [points[b] for b in range(points.shape[0])] if self._batched else [points]
        else:
            try:
                clouds = [np.asarray(cloud) for cloud in points] if self._batched else [np.asarray(points)]
            except (TypeError, ValueError) as error:
                raise ValueError(f"points can't be read as clouds of shape (P, 3): {error}.") from error
            for cloud in clouds:
                if cloud.ndim != 2 or cloud.shape[1] != 3 or cloud.dtype.kind not in "fiu":
                    raise ValueError(
                        f"points has shape {cloud.shape} and type {cloud.dtype}; it must be (P, 3) numbers [m]."
                    )
        if len(clouds) != self._batch:
            raise ValueError(f"points holds {len(clouds)} clouds; the batch has {self._batch} drones.")
        return clouds
