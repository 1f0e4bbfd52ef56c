"""The ring of sweeps on the planner's device."""

from __future__ import annotations

import heapq
import math
import operator
from collections import deque
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.array_memory import PackedArrays, allocate, as_dict
from aero_planner.arrays import CloudArrays, SweepTable
from aero_planner.kernels.shells import COUNTERS
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.sweeps import Arrival, Sweeps

_UNKNOWN_ARRIVAL = Arrival(math.nan, (math.nan, math.nan, math.nan))
_LEAST_PERIOD = 0.09
"""Time from one sweep to the next in which obstacles move visibly, a little less than that of a Mid-360 [s]."""


class _Sizes(NamedTuple):
    B: int
    S: int
    P: int
    E: int = int(COUNTERS)


class _Entry(NamedTuple):
    """A sweep in the ring."""

    points: NDArray[np.float32]
    arrival: Arrival | None
    number: int
    """Its number in the order of arrival."""
    row: int
    """Its row in the tables."""
    start: int
    """Index of its first point."""

    @property
    def end(self) -> int:
        return self.start + len(self.points)


class _Change(NamedTuple):
    """The values of `kernels.sweep_change.SweepChange`."""

    arrived: int
    thinned: int
    recent: list[int]
    time: float
    position: tuple[float, float, float]


class SweepMemory:
    """Sweeps on the device. Each is copied once, when it arrives.

    Then the launches of the pipeline at the arrival of a sweep track dynamic obstacles, thin a sweep that has grown
    old, and order points by distance.

    Args:
        device: device of the sweeps.
        batch: B, number of drones.
        sweeps: S, largest number of sweeps.
        points: P, room for the points of all sweeps of a drone.
        whole: number of newest sweeps that `store` keeps whole, as in `Sweeps`; None keeps all.
        remembered: number of newest sweeps that `store` keeps for each drone; None keeps all.

    Attributes:
        arrays: the sweeps on the device.
        change: how they change, on the device.
    """

    def __init__(
        self,
        device: wp.Device,
        batch: int,
        *,
        sweeps: int,
        points: int,
        whole: int | None = None,
        remembered: Sequence[int] | None = None,
    ) -> None:
        self._device = device
        self._sizes = sizes = _Sizes(batch, sweeps, max(points, 1))
        self._table = PackedArrays(SweepTable, sizes, device)
        table = as_dict(self._table.arrays)
        self.change = table.pop("change")
        self.arrays = allocate(CloudArrays, sizes, device, **table)
        self._next_number = 0
        self._entries: deque[_Entry] = deque()
        self._free_rows = list(range(sweeps))  # a heap
        self._whole = whole
        kept = np.array([] if remembered is None else remembered, dtype=np.int64)
        self._forgetful = np.flatnonzero(kept < sweeps)  # drones
        self._remembered = kept[self._forgetful]
        self._thinned: set[int] = set()  # rows
        self._unordered: list[int] = []  # rows that the device orders, which the table on the host does not mention yet
        self._is_change_due = False
        self._held: Sweeps | None = None
        self._is_motion_known = False  # that at the newest sweep
        self._staging: Any = None  # pinned memory of one sweep, small enough for the processor's cache
        self._staging_values: Any = None  # the same as NumPy array
        self._is_staging_free = True
        self._copied = None if device.is_cpu else wp.Event(device)

    def has_room(self, sweeps: Sweeps) -> bool:
        """Return True if the sweeps fit into the ring, wherever the oldest one begins."""
        if sweeps is self._held:
            return True
        return len(sweeps) <= self._sizes.S and sweeps.point_count + max(map(len, sweeps), default=0) <= self._sizes.P

    def hold(self, sweeps: Sweeps, run: Callable[[], None]) -> None:
        """Make the memory hold exactly these sweeps of one drone; copies those that it lacks. There must be room.

        Args:
            sweeps: the sweeps.
            run: runs the launches of a change. Those of the last change are left to the caller, see `take_change`.
        """
        if sweeps is self._held and self._is_motion_known:
            return
        self.finish_change(run)
        self._open_table()
        first_new = self._next_number
        if sweeps is not self._held:
            self._take_over(list(sweeps), sweeps.arrivals, sweeps.thinned)
        for i, change in enumerate(self._list_changes(first_new, sweeps.thinned)):
            if i > 0:
                self.finish_change(run)
                self._open_table()
            self._start_change(change)
        self._held, self._is_motion_known = sweeps, True

    def forget_motion(self) -> None:
        """Estimate the motion at the newest sweep again, because of another cloud or other parameters since."""
        self._is_motion_known = False

    def take_change(self) -> bool:
        """Return True if the launches of a change are due. The caller runs them, as part of its own."""
        is_due, self._is_change_due = self._is_change_due, False
        return is_due

    def finish_change(self, run: Callable[[], None]) -> None:
        """Run the launches of a change if they are due."""
        if self.take_change():
            run()

    def _list_changes(self, first_new: int, thinned: int) -> list[_Change]:
        """Return the changes after which the sweeps from number `first_new` on are known and the oldest are thinned.

        Each new sweep shows the motion at its time, for which the sweeps before it are still whole.
        """
        entries = list(self._entries)
        whole = max(len(entries) - thinned, 1)
        aged = [entry.row for entry in entries[:thinned] if entry.row not in self._thinned]
        changes: list[_Change] = []
        known = len(entries) - sum(1 for _ in takewhile(lambda entry: entry.number >= first_new, reversed(entries)))
        for i, entry in enumerate(entries[known:], known):
            # Without all `RECENT` sweeps before it, only the newest one's motion matters.
            is_used = entry is entries[-1] or i >= int(RECENT) - 1
            recent = _recent_rows(entries[max(i + 1 - whole, 0) : i + 1] if is_used else [])
            old = entries[i - whole].row if i >= whole else -1
            if old in aged:
                aged.remove(old)
            else:
                old = -1
            time, position = entry.arrival or _UNKNOWN_ARRIVAL
            changes.append(_Change(entry.row, old, recent, time, position))
        recent = _recent_rows([] if changes or self._is_motion_known else entries[-whole:])
        rest = [_Change(-1, old, recent, *_UNKNOWN_ARRIVAL) for old in aged]
        return changes + rest or [_Change(-1, -1, recent, *_UNKNOWN_ARRIVAL)]

    def _start_change(self, change: _Change) -> None:
        """Copy a change to the device, with the open table; its launches are then due."""
        host = self._table.host()
        host["change"][0] = change
        # Until its points are ordered, a plan reads a sweep in whole, with the same result.
        self._unordered = [row for row in (change.arrived, change.thinned) if row >= 0]
        host["is_ordered"][self._unordered] = 0
        if change.thinned >= 0:
            self._thinned.add(change.thinned)
        self._table.upload()
        if self._copied is not None:
            self._device.stream.record_event(self._copied)
        self._is_change_due = True

    def _open_table(self) -> None:
        """Wait until pinned memory may be written again, and note which sweeps the device has ordered meanwhile.

        The copies ended long ago, unless sweeps arrive without plans.
        """
        if self._copied is not None:
            wp.synchronize_event(self._copied)
        self._is_staging_free = True
        self._table.host()["is_ordered"][self._unordered] = 1
        self._unordered = []

    def _take_over(self, sweeps: list[NDArray[np.float32]], arrivals: tuple[Arrival | None, ...], thinned: int) -> None:
        """Drop the sweeps that left and copy those that arrived; `thinned` is the number of sweeps to thin."""
        self._drop(len(self._entries) - self._count_kept(sweeps))
        if any(entry.row in self._thinned for entry in list(self._entries)[thinned:]):
            self._drop(len(self._entries))  # their other points are needed again
        kept = len(self._entries)
        for entry in self._place(sweeps[kept:], arrivals[kept:]):
            self._thinned.discard(entry.row)
            self._copy(entry)
        self._table.host()["oldest"][0] = self._entries[0].start if self._entries else 0

    def _drop(self, count: int) -> None:
        """Drop the oldest `count` sweeps."""
        counts = self._table.host()["count"]
        for _ in range(count):
            row = self._entries.popleft().row
            counts[:, row] = 0
            heapq.heappush(self._free_rows, row)

    def store(self, row: int, points: wp.array, run: Callable[[], None], *, time: float | None = None) -> None:
        """Replace a sweep by points on the device, vec3 [B, n]; all sweeps must have the same size.

        Args:
            row: which of the sweeps.
            points: vec3 [B, n] [m], world frame.
            run: runs the launches of a change.
            time: when it was complete [s]; None is the time of the inputs. The place is that of the inputs.

        Raises:
            ValueError: there is no room for this sweep.
        """
        size, start, S = points.shape[1], row * points.shape[1], self._sizes.S
        if not 0 <= row < S or points.shape[0] != self._sizes.B or start + size > self._sizes.P:
            raise ValueError(
                f"sweep {row} of {points.shape[0]} drones with {size} points does not fit; there is room for "
                f"{self._sizes.S} sweeps of {self._sizes.B} drones with {self._sizes.P} points in all."
            )
        self.finish_change(run)
        place: Any = self.arrays.points[:, start : start + size]
        wp.copy(place, points)
        self._open_table()
        host = self._table.host()
        host["count"][:, row], host["start"][row] = size, start
        host["count"][self._forgetful, (row - self._remembered) % S] = 0
        whole = self._whole or S
        recent = [(row - age) % S for age in range(min(int(RECENT), whole))]
        recent = [other for other in recent if host["count"][0, other]]
        old = (row - whole) % S
        aged = old if old != row and host["count"][0, old] else -1
        unknown_time, position = _UNKNOWN_ARRIVAL
        time = unknown_time if time is None else time
        self._start_change(_Change(row, aged, _padded(recent), time, position))
        self.finish_change(run)

    def _count_kept(self, sweeps: list[NDArray[np.float32]]) -> int:
        """Return how many of the newest sweeps in the ring are the first of `sweeps`."""
        held = [entry.points for entry in self._entries]
        first = range(max(len(held) - len(sweeps), 0), len(held))
        return next((len(held) - i for i in first if all(map(operator.is_, held[i:], sweeps))), 0)

    def _place(self, sweeps: list[NDArray[np.float32]], arrivals: tuple[Arrival | None, ...]) -> list[_Entry]:
        """Add sweeps to the ring and return their entries; those that are in the ring may move, and are among them."""
        host = self._table.host()
        added: list[_Entry] = []
        for points, arrival in zip(sweeps, arrivals, strict=True):
            start = self._free_place(len(points))
            if start is None:
                # The gaps are too large: begin again at the start of the ring.
                held = list(self._entries)
                self._drop(len(held))
                everything = [entry.points for entry in held] + sweeps[len(added) :]
                return self._place(everything, (*[entry.arrival for entry in held], *arrivals[len(added) :]))
            row = heapq.heappop(self._free_rows)
            added.append(_Entry(points, arrival, self._next_number, row, start))
            self._next_number += 1
            self._entries.append(added[-1])
            host["start"][row], host["count"][0, row], host["is_ordered"][row] = start, len(points), 0
        return added

    def _free_place(self, count: int) -> int | None:
        """Return the index at which the next sweep of `count` points begins, None if there is no such place."""
        if not self._entries:
            return 0
        oldest, end = self._entries[0].start, self._entries[-1].end
        if self._entries[-1].start < oldest:
            return end if end + count <= oldest else None
        if end + count <= self._sizes.P:
            return end
        return 0 if count <= oldest else None

    def _copy(self, entry: _Entry) -> None:
        """Copy a sweep to its place, on CUDA through pinned memory and without waiting."""
        if len(entry.points) == 0:
            return  # wp.copy takes a count of 0 for the whole array
        points = self.arrays.points
        if self._device.is_cpu:
            host: Any = points.numpy()
            host[0, entry.start : entry.end] = entry.points
            return
        count = len(entry.points)
        if self._staging is None or len(self._staging) < count:
            dtype: Any = wp.vec3
            self._staging = wp.empty(count * 5 // 4, dtype=dtype, device="cpu", pinned=True)
            self._staging_values = self._staging.numpy()
        elif not self._is_staging_free:  # several sweeps arrive at once, as when a flight begins
            wp.synchronize_stream(self._device.stream)
        self._staging_values[:count] = entry.points
        wp.copy(points, self._staging, entry.start, 0, count)
        self._is_staging_free = False


def _recent_rows(entries: list[_Entry]) -> list[int]:
    """Return the rows of the newest sweeps that show motion: those of a fast planner are partly left out."""
    recent: list[_Entry] = []
    for entry in reversed(entries):
        if len(recent) == int(RECENT):
            break
        later = recent[-1].arrival if recent else None
        if later is None or entry.arrival is None or entry.arrival.time <= later.time - _LEAST_PERIOD:
            recent.append(entry)
    return _padded([entry.row for entry in recent])


def _padded(rows: list[int]) -> list[int]:
    """Return at most `RECENT` rows, and -1 for those that are missing."""
    return rows + [-1] * (int(RECENT) - len(rows))
