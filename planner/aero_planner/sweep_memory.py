"""The ring of sweeps on the planner's device."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.array_memory import PackedArrays, allocate
from aero_planner.arrays import CloudArrays, SweepTable
from aero_planner.kernels.motion import RECENT
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.shells import COUNTERS, begin_shells, count_shells, fill_shells, start_sweep, thin_sweep
from aero_planner.kernels.wakes import WAKES
from aero_planner.motion import Motion, MotionEstimator
from aero_planner.sweeps import Arrival, Sweeps

_LEAST_PERIOD = 0.09
"""Time from one sweep to the next in which obstacles move visibly, a little less than that of a Mid-360 [s]."""


class _Sizes(NamedTuple):
    B: int
    S: int
    P: int
    E: int = int(COUNTERS)
    X: int = int(MOVERS)
    U: int = int(WAKES)


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


class SweepMemory:
    """Sweeps on the device. Each is copied once, when it arrives, and its points are then ordered by distance.

    Args:
        position: positions of the drones, vec3 [B], at which arriving sweeps are centred.
        params: live parameters, shape [B].
        sweeps: S, largest number of sweeps.
        points: P, room for the points of all sweeps of a drone.
        motion: estimates the motion of obstacles from the newest sweeps.
        whole: number of newest sweeps that `store` keeps whole, as in `Sweeps`; None keeps all.

    Attributes:
        arrays: the sweeps on the device.
    """

    def __init__(
        self,
        position: wp.array,
        params: wp.array,
        motion: Motion,
        *,
        sweeps: int,
        points: int,
        whole: int | None = None,
    ) -> None:
        device = wp.get_device(str(position.device))
        self._device = device
        self._motion = motion
        self._sizes = sizes = _Sizes(len(position), sweeps, max(points, 1))
        self._table = PackedArrays(SweepTable, sizes, device)
        arrays = allocate(CloudArrays, sizes, device)
        self.arrays = dataclasses.replace(arrays, **vars(self._table.arrays))
        self.arrays.number.fill_(-1)
        self._estimator = MotionEstimator(motion, self.arrays)
        self._next_number = 0
        self._entries: deque[_Entry] = deque()
        self._whole = whole
        self._thinned: set[int] = set()  # rows
        self._arrived: list[_Entry] = []  # sweeps to order
        self._ordered: list[_Entry] = []  # sweeps whose order the table does not mention yet
        self._held: Sweeps | None = None
        self._is_changed = False  # the table on the host, since it was copied
        self._is_motion_known = False  # that at the newest sweep
        self._host_points: Any = None  # the same places on the host, to copy from
        self._staging: Any = None  # `_host_points` as NumPy array
        self._copied: Any = None
        cloud, B = self.arrays.bundle(), sizes.B
        self._commands: list[tuple[Any, bool]] = []
        for kernel, inputs, is_per_point in (
            (start_sweep, [0, position, params], False),
            (count_shells, [0], True),
            (begin_shells, [0], False),
            (fill_shells, [0], True),
        ):
            size = (B, 1) if is_per_point else (B,)
            command = wp.launch(kernel, size, inputs=inputs, outputs=[cloud], device=device, record_cmd=True)
            self._commands.append((command, is_per_point))
        self._thin: Any = wp.launch(thin_sweep, (B, 1), inputs=[0], outputs=[cloud], device=device, record_cmd=True)

    def has_room(self, sweeps: Sweeps) -> bool:
        """Return True if the sweeps fit into the ring, wherever the oldest one begins."""
        return len(sweeps) <= self._sizes.S and sweeps.point_count + max(map(len, sweeps), default=0) <= self._sizes.P

    def hold(self, sweeps: Sweeps) -> None:
        """Make the memory hold exactly these sweeps of one drone; copies those that it lacks. There must be room."""
        self._mark_ordered()
        aged: list[_Entry] = []
        first_new = self._next_number
        if sweeps is not self._held:
            aged = self._take_over(list(sweeps), sweeps.arrivals, sweeps.thinned)
        if self._is_changed:
            self._table.upload()
            self._is_changed = False
        if sweeps is not self._held or not self._is_motion_known:
            self._estimate_motion(first_new, whole=max(len(sweeps) - sweeps.thinned, 1))
            self._held, self._is_motion_known = sweeps, True
        for entry in aged:
            self._thin_points(entry.row, len(entry.points))

    def forget_motion(self) -> None:
        """Estimate the motion at the newest sweep again, because of another cloud or other parameters since."""
        self._is_motion_known = False

    def _estimate_motion(self, first_new: int, *, whole: int) -> None:
        """Estimate the motion at the sweeps from number `first_new` on, each from the `whole` newest of its time."""
        entries = list(self._entries)
        if not entries:
            self._motion.forget()
            return
        for i, entry in enumerate(entries):
            is_newest, is_new = entry is entries[-1], entry.number >= first_new
            # Without all `RECENT` sweeps before it, only the newest one's motion matters.
            if (is_new and (is_newest or i >= int(RECENT) - 1)) or (is_newest and not self._is_motion_known):
                recent = _recent(entries[max(i + 1 - whole, 0) : i + 1])
                points = max(len(other.points) for other in recent)
                self._estimator.estimate([other.row for other in recent], entries[0].number, points)
        self._estimator.find_wakes(entries[0].number, entries[-1].number)

    def order_arrived(self) -> None:
        """Order the sweeps that `hold` has added. Until then a plan reads them in whole, with the same result.

        New sweeps are therefore ordered after a plan; on CUDA the host waits for the plan meanwhile.
        """
        for entry in self._arrived:
            self._order(entry.row, len(entry.points))
        self._ordered += self._arrived
        self._arrived = []

    def _mark_ordered(self) -> None:
        """Let the next plan use the order of the sweeps. Until this plan is done, the table may still be copied."""
        for entry in self._ordered:
            self._table.host()["is_ordered"][entry.row] = 1
            self._is_changed = True
        self._ordered = []

    def _take_over(
        self, sweeps: list[NDArray[np.float32]], arrivals: tuple[Arrival | None, ...], thinned: int
    ) -> list[_Entry]:
        """Drop the sweeps that left and copy those that arrived; return those of the oldest `thinned` still to thin."""
        kept = self._count_kept(sweeps)
        while len(self._entries) > kept:
            self._entries.popleft()
        if any(entry.row in self._thinned for entry in list(self._entries)[thinned:]):
            self._entries.clear()  # their other points are needed again
            kept = 0
        arrived = self._place(sweeps[kept:], arrivals[kept:])
        self._thinned -= {entry.row for entry in arrived}
        aged = [entry for entry in list(self._entries)[:thinned] if entry.row not in self._thinned]
        copied = {entry.row for entry in arrived}
        self._arrived = arrived + [entry for entry in aged if entry.row not in copied]
        self._write_table()
        for entry in arrived:
            self._copy(entry)
            known = {} if entry.arrival is None else entry.arrival._asdict()
            self._estimator.stamp(entry.row, entry.number, **known)
        return aged

    def store(self, row: int, points: wp.array, *, time: float | None = None) -> None:
        """Replace a sweep by points on the device, vec3 [B, n]; all sweeps must have the same size.

        Args:
            row: which of the sweeps.
            points: vec3 [B, n] [m], world frame.
            time: when it was complete [s]; None is the time of the inputs. The place is that of the inputs.

        Raises:
            ValueError: there is no room for this sweep.
        """
        size, start = points.shape[1], row * points.shape[1]
        if not 0 <= row < self._sizes.S or points.shape[0] != self._sizes.B or start + size > self._sizes.P:
            raise ValueError(
                f"sweep {row} of {points.shape[0]} drones with {size} points does not fit; there is room for "
                f"{self._sizes.S} sweeps of {self._sizes.B} drones with {self._sizes.P} points in all."
            )
        place: Any = self.arrays.points[:, start : start + size]
        wp.copy(place, points)
        host = self._table.host()
        if host["count"][0, row] != size or host["start"][row] != start:
            host["count"][:, row], host["start"][row], host["is_ordered"][row] = size, start, 1
            self._table.upload()
        number = self._next_number
        self._next_number += 1
        self._estimator.stamp(row, number, time=time)
        rows = [(row - age) % self._sizes.S for age in range(min(int(RECENT), self._whole or self._sizes.S))]
        oldest = max(number - self._sizes.S + 1, 0)
        self._estimator.estimate([r for r in rows if host["count"][0, r]], oldest, size)
        self._estimator.find_wakes(oldest, number)
        self._order(row, size)
        if self._whole is not None:
            aged = (row - self._whole) % self._sizes.S
            if host["count"][0, aged]:
                self._thin_points(aged, size)
                self._order(aged, size)

    def _count_kept(self, sweeps: list[NDArray[np.float32]]) -> int:
        """Return how many of the newest sweeps in the ring are the first of `sweeps`."""
        held = [entry.points for entry in self._entries]
        for count in range(min(len(held), len(sweeps)), 0, -1):
            if all(a is b for a, b in zip(held[len(held) - count :], sweeps, strict=False)):
                return count
        return 0

    def _place(self, sweeps: list[NDArray[np.float32]], arrivals: tuple[Arrival | None, ...]) -> list[_Entry]:
        """Add sweeps to the ring and return their entries; those that are in the ring may move, and are among them."""
        added: list[_Entry] = []
        for points, arrival in zip(sweeps, arrivals, strict=True):
            start = self._free_place(len(points))
            if start is None:
                # The gaps are too large: begin again at the start of the ring.
                held = list(self._entries)
                self._entries.clear()
                everything = [entry.points for entry in held] + sweeps[len(added) :]
                return self._place(everything, (*[entry.arrival for entry in held], *arrivals[len(added) :]))
            row = min(set(range(self._sizes.S)).difference(entry.row for entry in self._entries))
            added.append(_Entry(points, arrival, self._next_number, row, start))
            self._next_number += 1
            self._entries.append(added[-1])
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

    def _write_table(self) -> None:
        host = self._table.host()
        host["count"][:] = 0
        host["is_ordered"][[entry.row for entry in self._arrived]] = 0
        rows = [entry.row for entry in self._entries]
        host["start"][rows] = [entry.start for entry in self._entries]
        host["count"][0, rows] = [len(entry.points) for entry in self._entries]
        host["oldest"][0] = self._entries[0].start if self._entries else 0
        self._is_changed = True

    def _copy(self, entry: _Entry) -> None:
        """Copy a sweep to its place, on CUDA through pinned memory and without waiting."""
        if len(entry.points) == 0:
            return  # wp.copy takes a count of 0 for the whole array
        points = self.arrays.points
        if self._device.is_cpu:
            host: Any = points.numpy()
            host[0, entry.start : entry.end] = entry.points
            return
        if self._host_points is None:
            dtype: Any = wp.vec3
            self._host_points = wp.empty(self._sizes.P, dtype=dtype, device="cpu", pinned=True)
            self._staging = self._host_points.numpy()
            self._copied = wp.Event(self._device)
        else:
            wp.synchronize_event(self._copied)  # has happened long ago, unless sweeps arrive without plans
        self._staging[entry.start : entry.end] = entry.points
        wp.copy(points, self._host_points, entry.start, entry.start, len(entry.points))
        self._device.stream.record_event(self._copied)

    def _thin_points(self, row: int, count: int) -> None:
        self._thinned.add(row)
        if count:
            self._thin.set_param_at_index_from_ctype(0, row)
            self._thin.set_dim((self._sizes.B, count))
            self._thin.launch()

    def _order(self, row: int, count: int) -> None:
        """Order the points of a sweep by distance."""
        if count == 0:
            return
        for command, is_per_point in self._commands:
            command.set_param_at_index_from_ctype(0, row)
            if is_per_point:
                command.set_dim((self._sizes.B, count))
            command.launch()


def _recent(entries: list[_Entry]) -> list[_Entry]:
    """Return the newest sweeps, newest first, that show motion: those of a fast planner are partly left out."""
    recent: list[_Entry] = []
    for entry in reversed(entries):
        later = recent[-1].arrival if recent else None
        if later is None or entry.arrival is None or entry.arrival.time <= later.time - _LEAST_PERIOD:
            recent.append(entry)
    return recent[: int(RECENT)]
