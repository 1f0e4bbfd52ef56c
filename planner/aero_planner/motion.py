"""The motion of obstacles, estimated whenever a sweep arrives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from aero_planner.array_memory import allocate
from aero_planner.arrays import CloudArrays, MotionArrays, PlannerInputs
from aero_planner.kernels.motion import (
    BINS,
    BLOCK,
    RECENT,
    Circles,
    RecentRows,
    Segments,
    find_segments,
    list_segments,
    scan_obstacles,
    stamp_sweep,
)
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.records import bundle
from aero_planner.kernels.tracks import STARTS, FoundTracks, follow_segments, merge_tracks
from aero_planner.kernels.wakes import find_wakes


class _Sizes(NamedTuple):
    B: int
    L: int = int(RECENT)
    A: int = int(BINS)
    K: int = int(BINS) // int(BLOCK)
    X: int = int(MOVERS)
    Y: int = int(STARTS)


class Motion:
    """What moves around each drone.

    Args:
        inputs: inputs of the planner, which say when and where a sweep arrives if the caller does not.
        params: live parameters, shape [B].

    Attributes:
        arrays: the newest sweep, and what its tracks are made of.
    """

    def __init__(self, inputs: PlannerInputs, params: wp.array) -> None:
        self.inputs, self.params = inputs, params
        self.arrays = allocate(MotionArrays, _Sizes(len(params)), wp.get_device(str(params.device)))
        self.forget()

    def forget(self) -> None:
        """Treat all obstacles as static until the next sweep."""
        self.arrays.newest.fill_(-1)


class MotionEstimator:
    """Estimates the motion from the sweeps of a cloud.

    Launches are recorded once, and arguments that change are written into the memory that these launches read: a plan
    waits for the interpreter, and packing an argument takes as long as a launch.

    Args:
        motion: what moves, which is updated.
        cloud: all sweeps.
    """

    def __init__(self, motion: Motion, cloud: CloudArrays) -> None:
        self._device = wp.get_device(str(motion.params.device))
        self._drones = len(motion.params)
        self._scanned_points = 1
        """Points of a sweep for which `scan_obstacles` is launched."""
        self._scan = motion.arrays.scan
        a, i, params, sweeps = motion.arrays, motion.inputs, motion.params, cloud.bundle()
        segments = bundle(Segments, count=a.segment_count, center=a.segment_center, radius=a.segment_radius)
        found = bundle(FoundTracks, position=a.found_position, velocity=a.found_velocity, radius=a.found_radius)
        record = self._record
        recent: Any = RecentRows()
        place: Any = wp.vec3()
        self._recent_rows = np.frombuffer(recent, dtype=np.int32)
        self._place = np.frombuffer(place, dtype=np.float32)
        self._stamp = record(stamp_sweep, (), [0, 0, math.nan, place, i.time, i.position], [sweeps])
        self._scan_obstacles = record(
            scan_obstacles, (int(RECENT), 1), [recent, sweeps, i.ground_height, params], [self._scan]
        )
        counts: Any = self._scan[:, :, int(BINS) :]
        circles = bundle(Circles, center=a.circle_center, radius=a.circle_radius, count=counts)
        bins, starts = (int(RECENT), int(BINS)), (int(STARTS), int(MOVERS))
        self._find_segments = record(find_segments, bins, [recent, sweeps, params, self._scan], [circles])
        self._list_segments = record(list_segments, bins, [circles], [segments])
        self._follow_segments = record(follow_segments, starts, [recent, sweeps, params, self._scan, segments], [found])
        self._merge = record(merge_tracks, (), [recent, 0, params, self._scan, found], [a.newest, sweeps])
        self._find_wakes = record(find_wakes, (len(cloud.start),), [0, 0, params], [sweeps])

    def _record(self, kernel: Any, size: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> Any:
        dim = (self._drones, *size)
        return wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True)

    def stamp(
        self, row: int, number: int, *, time: float | None = None, position: Sequence[float] | None = None
    ) -> None:
        """Keep when [s] and where [m] a sweep was complete; None is the time or the position of the inputs.

        Args:
            row: row of the sweep.
            number: its number in the order of arrival.
            time, position: [s], [m].
        """
        self._place[:] = math.nan if position is None else position
        _launch(self._stamp, row, number, math.nan if time is None else time)

    def estimate(self, rows: list[int], oldest: int, points: int) -> None:
        """Estimate the motion from sweeps that follow each other; the first one becomes the newest.

        Args:
            rows: rows of the sweeps, newest first, of which the first `RECENT` are used.
            oldest: number of the oldest sweep in memory.
            points: number of points of the largest of them.
        """
        used = min(len(rows), int(RECENT))
        self._recent_rows[:used], self._recent_rows[used:] = rows[:used], -1
        self._scan.zero_()
        if points > self._scanned_points:
            # Threads past the end of a sweep do nothing.
            self._scanned_points = points
            self._scan_obstacles.set_dim((self._drones, int(RECENT), self._scanned_points))
        for command in (self._scan_obstacles, self._find_segments, self._list_segments, self._follow_segments):
            command.launch()
        _launch(self._merge, oldest, first=1)

    def find_wakes(self, oldest: int, newest: int) -> None:
        """Find which points of the sweeps belong to obstacles that have moved on.

        Args:
            oldest, newest: numbers of the first and the last sweep in memory.
        """
        _launch(self._find_wakes, oldest, newest)


def _launch(command: Any, *values: float, first: int = 0) -> None:
    """Launch a recorded command with other values of its arguments from number `first` on, which are numbers."""
    for i, value in enumerate(values, first):
        command.set_param_at_index_from_ctype(i, value)
    command.launch()
