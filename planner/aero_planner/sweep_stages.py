"""The launches that take a sweep into the memory: motion of obstacles, thinning, and the order of the points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from aero_planner.arrays import CloudArrays
from aero_planner.kernels import motion, shells, tracks, wakes
from aero_planner.kernels.kernel_tuning import CPU, CUDA
from aero_planner.kernels.records import bundle
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.launch_sequence import LaunchSequence
from aero_planner.motion import Motion


class SweepStages:
    """Records these launches. They read from the device how the sweeps change, so that they serve every sweep.

    Args:
        sequence: sequence of which the launches are part.
        cloud: the sweeps.
        change: how they change, `SweepChange` [1].
        moving: what moves, which is updated.
    """

    def __init__(self, sequence: LaunchSequence, cloud: CloudArrays, change: wp.array, moving: Motion) -> None:
        self._record = sequence.record
        self._cloud, self._change, self._motion = cloud, change, moving
        self._sweeps = cloud.bundle()
        self._drones, points = cloud.points.shape
        tuning = CPU if wp.get_device(str(change.device)).is_cpu else CUDA
        self._threads = tuning.threads_per_sweep(self._drones * int(RECENT), points)

    def estimate_motion(self) -> list[Callable[[], Any]]:
        """Find what moves, and the wakes that it has left, from the sweep that arrives and those before it."""
        a, i, params, change, sweeps = (
            self._motion.arrays, self._motion.inputs, self._motion.params, self._change, self._sweeps,
        )  # fmt: skip
        B, record = self._drones, self._record
        recent, bins, starts = int(RECENT), a.circle_radius.shape[2], a.found_radius.shape[1:]
        counts: Any = a.scan[:, :, bins:]
        circles = bundle(motion.Circles, center=a.circle_center, radius=a.circle_radius, count=counts)
        segments = bundle(motion.Segments, count=a.segment_count, center=a.segment_center, radius=a.segment_radius)
        found = bundle(tracks.FoundTracks, position=a.found_position, velocity=a.found_velocity, radius=a.found_radius)
        return [
            a.scan.zero_,
            record(motion.stamp_sweep, (B,), inputs=[change, i.time, i.position], outputs=[sweeps]),
            record(
                motion.scan_obstacles,
                (B, recent, self._threads),
                inputs=[self._threads, change, sweeps, i.ground_height, params],
                outputs=[a.scan],
            ),
            record(motion.find_segments, (B, recent, bins), inputs=[change, sweeps, params, a.scan], outputs=[circles]),
            record(motion.list_segments, (B, recent, bins), inputs=[circles], outputs=[segments]),
            record(
                tracks.follow_segments,
                (B, *starts),
                inputs=[change, sweeps, params, a.scan, segments],
                outputs=[found],
            ),
            record(tracks.merge_tracks, (B,), inputs=[change, params, a.scan, found], outputs=[a.newest, sweeps]),
            record(wakes.find_wakes, (B, len(self._cloud.start)), inputs=[change, params], outputs=[sweeps]),
        ]

    def thin(self) -> list[Callable[[], Any]]:
        """Remove most points of the sweep that is thinned."""
        inputs, size = [self._threads, self._change], (self._drones, self._threads)
        return [self._record(shells.thin_sweep, size, inputs=inputs, outputs=[self._sweeps])]

    def order_points(self) -> list[Callable[[], Any]]:
        """Order the points of the sweeps that change by distance."""
        B, threads, change = self._drones, self._threads, self._change
        start = [change, self._motion.inputs.position, self._motion.params]
        return [
            self._record(kernel, size, inputs=inputs, outputs=[self._sweeps])
            for kernel, size, inputs in (
                (shells.start_shells, (B, 2), start),
                (shells.count_shells, (B, 2, threads), [threads, change]),
                (shells.begin_shells, (B, 2), [change]),
                (shells.fill_shells, (B, 2, threads), [threads, change]),
            )
        ]
