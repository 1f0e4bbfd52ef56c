"""The points of a batch on a device, and how they get there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

__all__ = ["Cloud", "Points"]

Points = NDArray[Any] | wp.array | Sequence[NDArray[Any]]


class Cloud:
    """Points of B drones in one array on the device.

    Args:
        batch: B, or None for one drone whose points have no leading axis.
        device: where they live.

    Attributes:
        array: shape [B, P], vec3 [m], world frame; NaN where nothing was written yet.
    """

    def __init__(self, batch: int | None, device: wp.Device) -> None:
        self._batched = batch is not None
        self._batch = batch or 1
        self._device = device
        self._given: Any = None
        self._mail: _Mail | None = None
        self._sent: int | None = None
        self.array: wp.array = wp.full((self._batch, 1), wp.vec3(np.nan), dtype=wp.vec3, device=device)

    @property
    def capacity(self) -> int:
        """P, the most points of a drone."""
        return self.array.shape[1]

    def forget(self) -> None:
        """Take for new whatever is written next: the caller may have changed the array."""
        self._given = None

    def reserve(self, count: int) -> bool:
        """Make room for `count` points of each drone, all NaN; return whether the array is another one."""
        self._given = self._sent = None
        if count == self.capacity:
            self.array.fill_(wp.vec3(np.nan))
            return False
        self.array = wp.full((self._batch, max(count, 1)), wp.vec3(np.nan), dtype=wp.vec3, device=self._device)
        return True

    def knows(self, points: Points) -> bool:
        """Return whether the array holds `points` already: the same object, which nobody can have changed since."""
        return self._given is not None and self._given is points

    def write(self, clouds: list[Any], points: Points) -> None:
        """Copy the clouds that `split` has made of `points`; there must be room. What was sent before is forgotten."""
        self._sent = None
        for b, cloud in enumerate(clouds):
            row: Any = self.array[b]
            if isinstance(cloud, wp.array):
                wp.copy(row, cloud, count=len(cloud))
            elif self._device.is_cpu:
                self.array.numpy()[b, : len(cloud)] = cloud
            else:
                source = wp.array(
                    np.ascontiguousarray(cloud, dtype=np.float32), dtype=wp.vec3, device="cpu", copy=False
                )
                wp.copy(row, source, count=len(cloud))
        is_constant = isinstance(points, np.ndarray) and points.base is None and not points.flags.writeable
        self._given = points if is_constant else None

    def send(self, points: ArrayLike, first: int) -> None:
        """Start to copy points, shape [n, 3], or [B, n, 3] for a batch, beside what the device does.

        `receive` puts them to the places from `first` on. On the CPU they are there at once.

        Raises:
            ValueError: they have another shape, or no room there.
        """
        values = np.asarray(points)
        if values.ndim != 2 + self._batched or values.shape[-1] != 3 or values.dtype.kind not in "fiu":
            raise ValueError(f"points has shape {values.shape} and type {values.dtype}; {self._wanted('n')}.")
        values = values.reshape(-1, *values.shape[-2:])
        count = values.shape[1]
        if len(values) != self._batch:
            raise ValueError(f"points has shape {np.shape(points)}; {self._wanted('n')}.")
        if first < 0 or first + count > self.capacity:
            raise ValueError(
                f"there is room for {self.capacity} points, not for those from {first} to {first + count}; "
                "call reserve before."
            )
        self._given = None
        if self._device.is_cpu:
            self.array.numpy()[:, first : first + count] = values
            return
        self.receive()
        mail = self._mail
        if mail is None or mail.spare.shape[1] != count:
            mail = self._mail = _Mail(self._batch, count, self._device)
        mail.send(values)
        self._sent = first

    def receive(self) -> None:
        """Put what was sent to its place, before what the device's stream does next."""
        first, mail = self._sent, self._mail
        if first is not None and mail is not None:
            self._sent = None
            mail.receive(self.array, first)

    def split(self, points: Points) -> list[Any]:
        """Return the cloud of each drone.

        Raises:
            ValueError: there are more or fewer clouds than drones, or one has another shape or type.
        """
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

    def _wanted(self, count: str) -> str:
        shape = f"({self._batch}, {count}, 3)" if self._batched else f"({count}, 3)"
        return f"it must be numbers [m] of shape {shape}"


class _Mail:
    """Points on their way: page-locked memory of the host, and a place on the device that no plan reads."""

    def __init__(self, batch: int, count: int, device: wp.Device) -> None:
        self.spare = wp.zeros((batch, count), dtype=wp.vec3, device=device)
        self._pinned = wp.zeros((batch, count), dtype=wp.vec3, device="cpu", pinned=True)
        self._device = device
        self._stream = wp.Stream(device)
        self._arrived, self._taken = wp.Event(device), wp.Event(device)
        device.stream.record_event(self._taken)
        self._stream.record_event(self._arrived)

    def send(self, values: NDArray[Any]) -> None:
        wp.synchronize_event(self._arrived)  # the copy before this one still reads the page-locked memory
        self._pinned.numpy()[:] = values
        self._stream.wait_event(self._taken)
        wp.copy(self.spare, self._pinned, stream=self._stream)
        self._stream.record_event(self._arrived)

    def receive(self, array: wp.array, first: int) -> None:
        stream = self._device.stream
        stream.wait_event(self._arrived)
        for b in range(array.shape[0]):
            row, sent = cast("Any", array[b]), cast("Any", self.spare[b])
            wp.copy(row, sent, dest_offset=first, count=self.spare.shape[1])
        stream.record_event(self._taken)
