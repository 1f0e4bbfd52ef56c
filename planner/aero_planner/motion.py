"""The motion of obstacles, estimated whenever a sweep arrives."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from aero_planner.array_memory import allocate
from aero_planner.arrays import CloudArrays, MotionArrays, PlannerInputs
from aero_planner.kernels.motion import BINS, RECENT, RecentRows, Segments, find_segments, scan_obstacles, stamp_sweep
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.records import bundle
from aero_planner.kernels.tracks import STARTS, FoundTracks, follow_segments, merge_tracks
from aero_planner.kernels.wakes import find_wakes


class _Sizes(NamedTuple):
    B: int
    L: int = int(RECENT)
    A: int = int(BINS)
    X: int = int(MOVERS)
    Y: int = int(STARTS)


class Motion:
    """Finds the moving obstacles around each drone.

    Args:
        inputs: inputs of the planner, which say when and where a sweep arrives if the caller does not.
        params: live parameters, shape [B].

    Attributes:
        arrays: the newest sweep, and what its tracks are made of.
    """

    def __init__(self, inputs: PlannerInputs, params: wp.array) -> None:
        self._inputs, self._params = inputs, params
        self._device = wp.get_device(str(params.device))
        self.arrays = arrays = allocate(MotionArrays, _Sizes(len(params)), self._device)
        self._segments = bundle(
            Segments, count=arrays.segment_count, center=arrays.segment_center, radius=arrays.segment_radius
        )
        self._found = bundle(
            FoundTracks, position=arrays.found_position, velocity=arrays.found_velocity, radius=arrays.found_radius
        )
        self.forget()

    def forget(self) -> None:
        """Treat all obstacles as static until the next sweep."""
        self.arrays.newest.fill_(-1)

    def stamp(
        self,
        cloud: CloudArrays,
        row: int,
        number: int,
        *,
        time: float | None = None,
        position: ArrayLike | None = None,
    ) -> None:
        """Keep when [s] and where [m] a sweep was complete; None is the time or the position of the inputs.

        Args:
            cloud: all sweeps.
            row: row of the sweep.
            number: its number in the order of arrival.
            time, position: [s], [m].
        """
        given_time = math.nan if time is None else time
        given_position = wp.vec3(math.nan) if position is None else wp.vec3(*np.asarray(position, dtype=np.float32))
        inputs = [row, number, given_time, given_position, self._inputs.time, self._inputs.position]
        self._launch(stamp_sweep, (), inputs, [cloud.bundle()])

    def estimate(self, cloud: CloudArrays, rows: list[int], oldest: int, points: int) -> None:
        """Estimate the motion from sweeps that follow each other; the first one becomes the newest.

        Args:
            cloud: all sweeps.
            rows: rows of the sweeps, newest first, of which the first `RECENT` are used.
            oldest: number of the oldest sweep in memory.
            points: number of points of the largest of them.
        """
        recent: Any = RecentRows(*rows[:RECENT], *[-1] * (int(RECENT) - len(rows)))
        i, arrays, sweeps = self._inputs, self.arrays, cloud.bundle()
        arrays.scan.zero_()
        size = (int(RECENT), points)
        self._launch(scan_obstacles, size, [recent, sweeps, i.ground_height, self._params], [arrays.scan])
        self._launch(find_segments, (int(RECENT),), [recent, sweeps, self._params, arrays.scan], [self._segments])
        size = (int(STARTS), int(MOVERS))
        inputs = [recent, sweeps, self._params, arrays.scan, self._segments]
        self._launch(follow_segments, size, inputs, [self._found])
        self._launch(
            merge_tracks, (), [recent, oldest, self._params, arrays.scan, self._found], [arrays.newest, sweeps]
        )

    def find_wakes(self, cloud: CloudArrays, oldest: int, newest: int) -> None:
        """Find which points of the sweeps belong to obstacles that have moved on.

        Args:
            cloud: all sweeps.
            oldest, newest: numbers of the first and the last sweep in memory.
        """
        self._launch(find_wakes, (len(cloud.start),), [oldest, newest, self._params], [cloud.bundle()])

    def _launch(self, kernel: Any, size: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, (len(self._params), *size), inputs=inputs, outputs=outputs, device=self._device)
