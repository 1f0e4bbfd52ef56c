"""A recording: sweeps that are read on demand, and the poses they were measured from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import compose_transforms, rotation_matrix
from aero_viz.errors import UserError
from aero_viz.input_limits import ReadingBudget
from aero_viz.point_times import UNITS
from aero_viz.recordings.axes import other_axes
from aero_viz.recordings.bag_file import BagFile
from aero_viz.recordings.choices import CloudFrame
from aero_viz.recordings.clocks import find_clock_fault
from aero_viz.recordings.clouds import read_cloud
from aero_viz.recordings.contents import CloudEntry, Contents
from aero_viz.recordings.depth_image import Intrinsics
from aero_viz.recordings.finding import Finding
from aero_viz.recordings.point_cloud2 import DecodedPoints, RawCloud, common_time_unit, decode_points
from aero_viz.recordings.poses import RecordedPoses
from aero_viz.recordings.sensors import choose_sensor
from aero_viz.recordings.storage import Storage
from aero_viz.recordings.topics import PoseSource, choose_cloud_topic, choose_poses, suggest_other_clouds
from aero_viz.recordings.transforms import IDENTITY, Transform

NO_POSES = (
    "no poses are recorded: the sensor is assumed to stand still; play with --odometry auto to estimate its motion "
    "from the sweeps"
)
"""Notice for a recording without poses."""

_CACHED_SWEEPS = 4
_UNIT_SAMPLES = 8
"""Number of sweeps that settle the unit of the times of points."""
_PREFETCHED_SWEEPS, _PREFETCHED_BYTES = 4, 32 << 20
"""Sweeps that the system reads ahead of the playback, and their largest length."""


class PointSweep(NamedTuple):
    """One sweep of the LiDAR."""

    time: float
    """Its stamp [s] from the recording's first playable sweep."""
    points: NDArray[np.float32]
    """Valid points [P, 3] [m], body frame. Unless the recording has an extrinsic, that is the sensor's frame."""
    point_times: NDArray[np.float32] | None
    """Time of each point after `time` [P] [s], None if it was not recorded."""
    dropped: int
    """Number of points left out because they are not finite, beyond any range, or all zero ("no return")."""


class Recording:
    """A recording of LiDAR sweeps and poses, opened by `open_recording`. Use it from one thread at a time.

    Time is in seconds from the first playable sweep, which is the first one that has points and a pose. If the
    recording says how the sensor is mounted (static transforms from the frame of the poses to that of the clouds),
    points are moved into the body's frame; otherwise the sensor is the body.
    """

    def __init__(self, storage: Storage, contents: Contents, points_topic: str | None, pose_topic: str | None):
        self._storage = storage
        self._mask: NDArray[np.float32] | None = None
        self.path = storage.path
        self.format = storage.format
        """Name of the format, such as "mcap", "rosbag2-sqlite3" or "lvx2"."""
        self.problems: list[str] = list(contents.problems)
        """Notices for the user, one sentence each."""
        self.frame_fault: Finding | None = None
        """Set if the clouds are said to be in the frame of the world, but move with the body."""
        cloud, notice = choose_cloud_topic(contents, points_topic)
        self.problems += [notice] if notice else []
        self.points_topic = cloud.name
        self.points_type, self._encoding = cloud.type, cloud.encoding
        clouds = [entry for entry in cloud.clouds if entry.count]
        entries = sorted(self._of_one_sensor(clouds, contents, storage.choices.sensor), key=lambda entry: entry.time)
        if not entries:
            advice = suggest_other_clouds(contents, cloud)
            raise UserError(f"No sweep on {cloud.name} of {self.path} has a point{advice}.")
        if len(clouds) < len(cloud.clouds):
            empty = len(cloud.clouds) - len(clouds)
            self.problems.append(f"{empty} of {len(cloud.clouds)} sweeps on {cloud.name} have no points: left out")
        self._set_timeline(contents, entries, pose_topic, storage.choices.cloud_frame)
        self.sweep_counts = np.array([entry.count for entry in self._entries], np.int64)
        """Number of points in each playable sweep [n], invalid ones included."""
        self.damaged_sweeps: set[int] = set()
        """Playable sweeps that turned out to be unreadable. They play as sweeps without points."""
        period = float(np.median(np.diff(self.sweep_times))) if len(self.sweep_times) > 1 else None
        self.time_unit = common_time_unit(self._sampled_clouds(), period)
        """Unit of the times of points [s], None where they have none."""
        if self.time_unit is not None and self.time_unit not in UNITS:
            self.problems.append(
                f"the times of points run from 0 to 1 and are taken for shares of a sweep of {self.time_unit:.3g} s"
            )
        self._cached_sweep = lru_cache(maxsize=_CACHED_SWEEPS)(self._read_sweep)
        if not self._has_valid_point():
            advice = suggest_other_clouds(contents, cloud)
            raise UserError(
                f"No sweep on {cloud.name} of {self.path} has a valid point: all are zero, not finite or beyond any "
                f"range{advice}."
            )

    def _set_timeline(
        self,
        contents: Contents,
        entries: list[CloudEntry],
        pose_topic: str | None,
        cloud_frame: CloudFrame,
    ) -> None:
        """Choose the poses and the clock, and keep the sweeps that have a pose."""
        times = np.array([(entry.time, entry.arrival) for entry in entries], np.int64)
        fault = find_clock_fault(*times.T)
        if fault is not None:
            self.problems.append(f"sweeps on {self.points_topic}: {fault.text}")
        use_stamps = fault is None or not fault.use_arrivals
        if not use_stamps:
            entries = sorted(entries, key=lambda entry: entry.arrival)
        start = entries[0].time if use_stamps else entries[0].arrival
        source, stamped, covered, notice = choose_poses(contents, entries, pose_topic, use_stamps=use_stamps)
        if source is None:
            self.problems += [NO_POSES, *filter(None, [notice])]
        elif not covered.all():
            self.problems.append(f"no pose covers sweeps {_format_ranges(np.flatnonzero(~covered))} of {len(entries)}")
        if use_stamps and not stamped:
            self.problems.append("the stamps of sweeps and poses are on different clocks: times of recording are used")
        if source is not None and source.in_world and cloud_frame == "body":
            self.problems.append(
                f"clouds in {entries[0].frame!r} are taken to move with the body, as --cloud-frame says"
            )
        elif source is not None and source.notice:
            self.problems.append(source.notice)
        kept = [entry for entry, keep in zip(entries, covered, strict=True) if keep]
        times = np.array([entry.time if stamped else entry.arrival for entry in kept], np.int64)
        order = np.argsort(times, kind="stable")
        times = times[order]
        self._entries = [kept[i] for i in order]
        self.sweep_times: NDArray[np.float64] = (times - times[0]) * 1e-9
        """Times of the playable sweeps [n] [s] from the first one, ascending."""
        self.start = int(times[0])
        """Stamp of the first playable sweep [ns]."""
        self.cloud_frame = entries[0].frame
        """Frame of the clouds. Those of other frames on the topic are moved to it."""
        self.other_frames = self._join_frames(contents)
        """Poses of other frames on the topic in `cloud_frame`, by name."""
        self.is_stamped = stamped
        """True if times are those of the stamps, False if they are those of recording."""
        self.pose_source = source
        """Recorded poses as they were chosen, None if there are none."""
        self.pose_topic = source.topic if source else None
        self.pose_origin: Literal["", "recording", "file", "odometry"] = "recording" if source else ""
        """Origin of the poses; empty if there are none."""
        self.poses: RecordedPoses | None = None
        """Motion of the body, None if no poses are recorded."""
        self.extrinsic: Transform = IDENTITY
        """Pose of the sensor in the body's frame."""
        self._cloud_frame = cloud_frame
        self._registered: RecordedPoses | None = None
        if source is not None:
            self.poses = source.poses.shifted(float(times[0] - start) * 1e-9)
            self.extrinsic = source.extrinsic
            if cloud_frame == "world" or (source.in_world and cloud_frame != "body"):
                self._registered, self.extrinsic = self.poses, IDENTITY
        if self._registered is None:
            self._mount(contents, source, entries[0].file)

    def _mount(self, contents: Contents, source: PoseSource | None, file: BagFile) -> None:
        """Mount the sensor as the recording says, and turn the axes of frames whose names say that they differ."""
        body, axes = self.cloud_frame, self.cloud_frame
        if source is not None:
            body, axes = source.body, source.body if source.is_joined else self.cloud_frame
        elif file.mounting is not None:
            self.extrinsic = Transform(file.mounting.position, file.mounting.quaternion)
            self.problems.append(file.mounting.notice)
            return
        else:
            body = axes = contents.transforms.carrier(self.cloud_frame, world="")
            if body != self.cloud_frame and (joined := contents.transforms.between(body, self.cloud_frame)):
                self.extrinsic = joined
                self.problems.append(f"the sensor is mounted on {body!r} by /tf_static; --extrinsic replaces this")
        if found := other_axes(axes):
            turn = Transform(np.zeros(3), found.rotation)
            self.extrinsic = Transform(*compose_transforms(*turn, *self.extrinsic))
            self.problems.append(
                f"the axes of {axes!r} are {found.name} by its name: points are turned to forward, left, up; "
                "--extrinsic replaces this"
            )
        if self.poses is not None and (found := other_axes(body)):
            self.poses = self.poses.turned(found.rotation)

    def _of_one_sensor(self, entries: list[CloudEntry], contents: Contents, wanted: str | None) -> list[CloudEntry]:
        """Return the clouds of one sensor. Those in frames that static transforms join count as those of one."""
        roots: dict[str, str] = {}
        for frame in dict.fromkeys(entry.frame for entry in entries):
            joined = (root for root in roots.values() if contents.transforms.between(root, frame) is not None)
            roots[frame] = next(joined, frame)
        points: dict[str, int | None] = {}
        names = [" ".join(filter(None, (roots[entry.frame], entry.sensor))) for entry in entries]
        for name, entry in zip(names, entries, strict=True):
            points[name] = (points.get(name) or 0) + entry.count
        is_settled = bool(entries) and entries[0].file.is_of_chosen_sensor
        if len(points) < 2 and (wanted is None or is_settled or not points):
            return entries
        chosen, notice = choose_sensor(points, None if is_settled else wanted, f"{self.points_topic} of {self.path}")
        self.problems += [notice] if notice else []
        return [entry for name, entry in zip(names, entries, strict=True) if name == chosen]

    def _join_frames(self, contents: Contents) -> dict[str, Transform]:
        """Return the poses of other frames of the sweeps in `cloud_frame`."""
        frames = dict.fromkeys(entry.frame for entry in self._entries if entry.frame != self.cloud_frame)
        poses = {frame: contents.transforms.between(self.cloud_frame, frame) for frame in frames}
        return {frame: pose for frame, pose in poses.items() if pose is not None}

    def _sampled_clouds(self) -> Iterator[RawCloud]:
        """Yield the readable ones of some sweeps."""
        for index in np.unique(np.linspace(0, len(self._entries) - 1, _UNIT_SAMPLES).astype(int)):
            with contextlib.suppress(Exception):  # see `_read_sweep`
                yield self._read_cloud(self._entries[index])

    def _read_cloud(self, entry: CloudEntry) -> RawCloud:
        return read_cloud(entry.file.read(entry.position), self.points_type, self._encoding, entry.camera)

    def _has_valid_point(self) -> bool:
        """Return False if none of the sweeps has a valid point; True also where finding out would take too long."""
        budget = ReadingBudget(0, share=0.3)
        return any(budget.is_late or len(self.sweep(i).points) for i in range(len(self._entries)))

    def mount(self, extrinsic: Transform) -> None:
        """Move points to the body's frame by another pose of the sensor than the recorded one."""
        self.extrinsic = extrinsic
        self._cached_sweep.cache_clear()

    def mask(self, corners: Sequence[float]) -> None:
        """Leave out the points in a box, from x, y, z of the lower to those of the upper corner [6] [m], body frame."""
        self._mask = np.array(corners, np.float32).reshape(2, 3)
        self._cached_sweep.cache_clear()

    def keep(self, sweeps: NDArray[np.bool_]) -> None:
        """Play only some of the sweeps, [n], at least one. The first of them becomes time zero."""
        if sweeps.all():
            return
        self.problems.append(f"no pose covers sweeps {_format_ranges(np.flatnonzero(~sweeps))} of {len(sweeps)}")
        first = float(self.sweep_times[sweeps][0])
        self._entries = [entry for entry, kept in zip(self._entries, sweeps, strict=True) if kept]
        self.start += round(1e9 * first)
        self._registered = None if self._registered is None else self._registered.shifted(first)
        self.sweep_times, self.sweep_counts = self.sweep_times[sweeps] - first, self.sweep_counts[sweeps]
        self._cached_sweep.cache_clear()

    def use_poses(
        self, poses: RecordedPoses, name: str, problems: Iterable[str], *, origin: Literal["file", "odometry"]
    ) -> None:
        """Play with other poses than the recorded ones.

        Args:
            poses: motion of the body, in the time of this recording.
            name: name of their origin, in place of a topic.
            problems: notices for the user about them.
            origin: where they come from.
        """
        self.poses, self.pose_topic, self.pose_origin = poses, name, origin
        if self._cloud_frame == "world":
            self._registered = poses
            self._cached_sweep.cache_clear()
        self.problems = [*(problem for problem in self.problems if problem != NO_POSES), *problems]

    @property
    def sweep_numbers(self) -> list[int] | None:
        """Numbers in the names of the files of the playable sweeps; None unless every sweep has one of its own."""
        numbers = [entry.file.number(entry.position) for entry in self._entries]
        known = [number for number in numbers if number is not None]
        return known if len(set(known)) == len(numbers) else None

    @property
    def camera(self) -> Intrinsics | None:
        """Intrinsics of the camera of depth images."""
        return self._entries[0].camera

    @property
    def is_in_world(self) -> bool:
        """True if the clouds were recorded in the frame of the world, and are moved to the body by the poses."""
        return self._registered is not None

    @property
    def changes(self) -> tuple[bytes, ...]:
        """The mounting and the mask, for comparisons."""
        mask = b"" if self._mask is None else self._mask.tobytes()
        poses = (self.extrinsic, *self.other_frames.values())
        return *(values.tobytes() for pose in poses for values in pose), mask

    @property
    def damage(self) -> str | None:
        """Sentence that names the playable sweeps found to be unreadable so far; None if there are none."""
        if not self.damaged_sweeps:
            return None
        counts = f"{len(self.damaged_sweeps)} of {len(self._entries)} sweeps"
        return f"{counts} could not be read and played without points: {_format_ranges(sorted(self.damaged_sweeps))}."

    def sweep(self, index: int) -> PointSweep:
        """Return playable sweep `index`, without points if it is unreadable. The last few sweeps are cached."""
        return self._cached_sweep(index)

    def _read_sweep(self, index: int) -> PointSweep:
        entry = self._entries[index]
        pose = None if self._registered is None else self._registered.interpolate(self.sweep_times[index])
        origin = None if self._registered is None or pose is None else self._registered.offset + pose.position
        try:
            decoded = decode_points(self._read_cloud(entry), unit=self.time_unit, origin=origin)
        except Exception:  # decompressors and SQLite fail in many ways; one bad sweep must not end the playback
            decoded = DecodedPoints(np.empty((0, 3), np.float32), None, entry.count)
            self.damaged_sweeps.add(index)
        self._prefetch(index + 1)
        points, times = decoded.points, decoded.times
        if entry.frame in self.other_frames:
            points = self.other_frames[entry.frame].move(points)
        if pose is not None:  # whoever moved the points to the world corrected their motion
            points, times = (points @ rotation_matrix(pose.quaternion)).astype(np.float32), None
        if self.extrinsic is not IDENTITY:
            points = self.extrinsic.move(points)
        if self._mask is not None:
            kept = ~((points >= self._mask[0]) & (points <= self._mask[1])).all(axis=1)
            points, times = points[kept], None if times is None else times[kept]
        return PointSweep(float(self.sweep_times[index]), points, times, decoded.dropped)

    def _prefetch(self, index: int) -> None:
        budget = _PREFETCHED_BYTES
        for entry in self._entries[index : index + _PREFETCHED_SWEEPS]:
            budget -= entry.file.prefetch(entry.position, budget)

    def close(self) -> None:
        """Close the files."""
        self._cached_sweep.cache_clear()
        self._storage.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _format_ranges(indices: Iterable[int]) -> str:
    """Return "0..3, 7" for 0, 1, 2, 3, 7."""
    runs: list[list[int]] = []
    for index in indices:
        if runs and index == runs[-1][1] + 1:
            runs[-1][1] = int(index)
        else:
            runs.append([int(index), int(index)])
    words = [str(first) if first == last else f"{first}..{last}" for first, last in runs]
    return ", ".join(words[:6]) + (f" and {len(words) - 6} more runs" if len(words) > 6 else "")
