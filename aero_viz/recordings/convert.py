"""Writes a recording, or a part of it, as ROS 2 MCAP that Foxglove, RViz and rosbags open."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from aero_planner import VehicleState
from aero_planner.onboard.ros_messages import BODY, DEFINITIONS, Encoded, pose_messages
from aero_planner.output_files import whole_file
from aero_viz.errors import UserError
from aero_viz.point_times import point_times
from aero_viz.recordings.bag_file import BagFile, Channel, Message, one_line
from aero_viz.recordings.cloud_files import CloudSequence
from aero_viz.recordings.clouds import CLOUD_TYPES, read_cloud
from aero_viz.recordings.contents import read_contents
from aero_viz.recordings.other_clouds import LASER_SCAN
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.ros_messages import (
    ENCODINGS,
    TF_TYPES,
    decode_message,
    encode_message,
    message_definition,
    message_type,
    ros1_to_cdr,
)
from aero_viz.recordings.storage import Storage, open_storage, readable
from aero_viz.text_table import format_size

_ODOMETRY_TOPICS = ("/odometry", "/tf")
_COPIED = (POINT_CLOUD2, LASER_SCAN)
"""Types of clouds that are written as they are."""


@dataclasses.dataclass(frozen=True)
class Window:
    """Times of recording of the messages that are written [ns], both ends included."""

    start: int | float
    """An infinite one is a float."""
    end: int | float

    @classmethod
    def after(cls, first: int, start: float, end: float) -> Window:
        """Return the window between two times [s] after the first message [ns]."""
        return cls(*(first + round(1e9 * time) if math.isfinite(time) else time for time in (start, end)))

    def holds(self, time: int) -> bool:
        """Return True for a time in the window."""
        return self.start <= time <= self.end

    def nearest(self, time: int) -> int:
        """Return the time in the window that is nearest to a time."""
        return int(min(max(time, self.start), self.end))


@dataclasses.dataclass(frozen=True)
class ConvertReport:
    """Report on the file that was written."""

    path: str
    messages: int
    """Number of messages written."""
    topics: dict[str, int]
    """Number of messages written, by topic."""
    left_out: dict[str, str]
    """Reasons why topics are not in the file, by topic."""
    bytes: int
    notes: list[str]
    """Defects of the recording and differences of the file, one sentence each."""

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return dataclasses.asdict(self)

    def format_table(self) -> str:
        """Return the report as text for a terminal."""
        lines = [f"{self.path}: {self.messages} messages on {len(self.topics)} topics, {format_size(self.bytes)}"]
        lines += [f"note: {topic} is left out: {reason}" for topic, reason in self.left_out.items()]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def convert(
    source: str | Path,
    target: str | Path,
    *,
    start: float = 0.0,
    end: float = float("inf"),
    topics: Collection[str] = (),
    decimate: int = 1,
    recording: Recording | None = None,
    progress: Callable[[float, float], None] = lambda done, total: None,
) -> ConvertReport:
    """Write the messages of a recording with their stamps and times of recording. An existing file is replaced.

    Messages of ROS 1 become those of ROS 2, and Livox's own clouds PointCloud2.

    Args:
        source: recording.
        target: MCAP file to write; it appears when it is complete.
        start, end: only messages between these times after the first message are written [s]. Transforms on /tf_static
            hold for the whole recording: those before and after are written with the nearest time in between.
        topics: only these topics and /tf_static are written; none means all.
        decimate: every `decimate`-th point of a cloud is kept.
        recording: the opened recording, if its estimated poses are to be written as /odometry and /tf.
        progress: called with the time reached and the duration [s].

    Raises:
        UserError: the recording cannot be read, the file cannot be written, an option is out of range, or nothing is
            left to write.
    """
    target = Path(target)
    if decimate < 1:
        raise UserError(f"--decimate must be at least 1, not {decimate}.")
    if not start < end:
        raise UserError(f"--start {start:g} must be before --end {end:g}.")
    storage = open_storage(source)
    try:
        with readable(storage.path):
            contents = read_contents(storage)
        refuse_source(target, storage)
        unknown = sorted(set(topics) - {topic.name for topic in contents.topics})
        if unknown:
            names = ", ".join(topic.name for topic in contents.topics)
            raise UserError(f"{source} has no topic {', '.join(unknown)}; it has {names}.")
        first = contents.first or 0
        window = Window.after(first, start, end)
        try:
            with whole_file(target) as partial, partial.open("wb") as file:
                output = _Output(Writer(file, compression=CompressionType.ZSTD), decimate)
                if recording is not None and recording.pose_origin in ("file", "odometry"):
                    output.write_poses(recording, window)
                for bag in storage.files:
                    output.copy(bag, window, topics, lambda time: progress((time - first) * 1e-9, contents.duration))
                output.finish()
                if output.is_empty:
                    reasons = [*output.left_out.values(), *output.damage()]
                    reasons = "; ".join(reasons) or f"the recording lasts {contents.duration:.1f} s"
                    raise UserError(f"Nothing of {source} is left to write: {reasons}.")
        except OSError as error:
            raise UserError(f"Cannot write {target}: {error.strerror or error}.") from error
        return ConvertReport(
            str(target),
            sum(output.counts.values()),
            output.counts,
            output.left_out,
            target.stat().st_size,
            [*(contents if recording is None else recording).problems, *output.damage(), *output.notes],
        )
    finally:
        storage.close()


def refuse_source(target: Path, storage: Storage) -> None:
    """Check that the file to write is not one of the files of a recording.

    Raises:
        UserError: it is one of them.
    """
    if any(file.path.resolve() == target.resolve() for file in storage.files):
        raise UserError(f"{target} is the recording itself; give another name to write to.")


class _Output:
    """Writes messages as ROS 2 (CDR).

    Args:
        writer: a new MCAP writer.
        decimate: every `decimate`-th point of a cloud is kept.
    """

    def __init__(self, writer: Writer, decimate: int) -> None:
        self.counts: dict[str, int] = {}
        self.left_out: dict[str, str] = {}
        self.notes: list[str] = []
        """Differences of what was written, one sentence each."""
        self.is_empty = True
        """True until a message was written that was asked for, which those on /tf_static are not in every case."""
        self._damaged: dict[str, list[str]] = {}
        """Reasons why messages could not be read, by topic."""
        self._writer, self._decimate = writer, decimate
        self._channels: dict[tuple[str, str], int] = {}
        self._own_poses = False
        writer.start(profile="ros2", library="aero-viz")

    def copy(self, bag: BagFile, window: Window, topics: Collection[str], progress: Callable[[int], None]) -> None:
        """Write the messages of a file."""
        for message in bag.scan(()):
            channel = message.channel
            is_chosen = (not topics or channel.topic in topics) and window.holds(message.time)
            if not is_chosen and not is_static(channel):
                continue
            if channel.topic in self.left_out:
                continue
            if self._own_poses and channel.topic in _ODOMETRY_TOPICS:
                self.left_out[channel.topic] = "other poses take its place"
                continue
            progress(message.time)
            if self._copy_message(bag, message, window.nearest(message.time)):
                self.is_empty &= not is_chosen

    def _copy_message(self, bag: BagFile, message: Message, time: int) -> bool:
        """Write a message with a time of recording [ns], and return whether it was written."""
        channel = message.channel
        kind = TF_TYPES[0] if channel.type in TF_TYPES else channel.type
        kind = POINT_CLOUD2 if kind in CLOUD_TYPES and kind != LASER_SCAN else kind
        definition = _definition(kind) or bag.definitions.get(channel.type)
        if channel.encoding not in ENCODINGS and channel.type not in CLOUD_TYPES:
            self.left_out[channel.topic] = f"its encoding is {channel.encoding or 'not given'}, not CDR or ROS 1"
            return False
        if definition is None or (channel.encoding == "ros1" and not _definition(kind)):
            self.left_out[channel.topic] = f"the type {channel.type} is not known here"
            return False
        try:
            data = self._converted(bag.read(message.position), channel)
        except Exception as error:  # decompressors and SQLite fail in many ways; the other messages are fine
            self._damaged.setdefault(channel.topic, []).append(one_line(error))
            return False
        if channel.topic not in self.counts:
            self._note_changes(bag, channel)
        self._add(Encoded(channel.topic, kind, data), time, definition)
        return True

    def _note_changes(self, bag: BagFile, channel: Channel) -> None:
        """Say once per topic what is not written of its clouds."""
        if channel.type == LASER_SCAN and self._decimate > 1:
            self.notes.append(f"scans on {channel.topic} are written whole: --decimate thins clouds only")
        elif channel.type in CLOUD_TYPES and (channel.type not in _COPIED or isinstance(bag, CloudSequence)):
            self.notes.append(
                f"points on {channel.topic} have x, y, z and, if known, a time: intensity and other values are left out"
            )

    def _converted(self, data: bytes, channel: Channel) -> bytes:
        if channel.type == POINT_CLOUD2 and self._decimate > 1:
            cdr = ros1_to_cdr(data, POINT_CLOUD2) if channel.encoding == "ros1" else data
            return _thinned(decode_message(cdr, POINT_CLOUD2, "cdr"), self._decimate)
        if channel.type in CLOUD_TYPES and channel.type not in _COPIED:
            cloud = read_cloud(data, channel.type, channel.encoding)
            rows = cloud.rows.reshape(-1)[:: self._decimate]
            points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
            return encode_point_cloud2(points, cloud.stamp, cloud.frame, times=_times(rows, cloud.stamp))
        if channel.encoding == "ros1":
            return ros1_to_cdr(data, TF_TYPES[0] if channel.type in TF_TYPES else channel.type)
        return data

    def write_poses(self, recording: Recording, window: Window) -> None:
        """Write the poses of a recording as /odometry and /tf, and the frame of the clouds as that of the body."""
        poses = recording.poses
        assert poses is not None
        self._own_poses = True
        written = 0
        for i, time in enumerate(poses.times):
            stamp = recording.start + round(1e9 * float(time))
            if window.holds(stamp):
                state = VehicleState(
                    poses.positions[i] + poses.offset, poses.velocities[i], poses.quaternions[i], time=float(time)
                )
                for message in pose_messages(state, stamp):
                    self._add(message, stamp, DEFINITIONS[message.kind])
                written += 1
                self.is_empty = False
        if written and recording.cloud_frame != BODY:
            stamp = int(max(recording.start, window.start))
            data = _static_transform(BODY, recording.cloud_frame, recording.extrinsic, stamp)
            self._add(Encoded("/tf_static", TF_TYPES[0], data), stamp, DEFINITIONS[TF_TYPES[0]])

    def _add(self, message: Encoded, time: int, definition: str) -> None:
        key = (message.topic, message.kind)
        if key not in self._channels:
            schema = self._writer.register_schema(message.kind, "ros2msg", definition.encode())
            self._channels[key] = self._writer.register_channel(message.topic, "cdr", schema)
        self._writer.add_message(self._channels[key], time, message.data, time)
        self.counts[message.topic] = self.counts.get(message.topic, 0) + 1

    def damage(self) -> list[str]:
        """Return a sentence on each topic whose messages could not all be read."""
        return [
            f"{len(reasons)} of {len(reasons) + self.counts.get(topic, 0)} messages on {topic} are left out, because "
            f"they cannot be read; the first: {reasons[0]}"
            for topic, reasons in self._damaged.items()
        ]

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()


def is_static(channel: Channel) -> bool:
    """Return True for a topic of transforms that hold for the whole recording, whenever they are published."""
    return channel.type in TF_TYPES and channel.topic.endswith("tf_static")


def _definition(kind: str) -> str | None:
    return DEFINITIONS.get(kind) or message_definition(kind)


def _times(rows: NDArray[np.void], stamp: int) -> NDArray[np.uint32] | NDArray[np.float32] | None:
    """Return the times of points after the stamp of their cloud: [ns] or, where some are before it, float32 [s]."""
    if "time" not in (rows.dtype.names or ()) or not len(rows):
        return None
    values = rows["time"]
    times = point_times(values, stamp)
    if times is None or times.min() < 0.0:
        return times
    if values.dtype.kind in "iu" and abs(1e-9 * float(values.max()) - times.max()) < 1e-6:
        return values.astype(np.uint32)  # exact, as they were recorded
    return np.rint(1e9 * times.astype(np.float64)).astype(np.uint32)


def _thinned(cloud: Any, step: int) -> bytes:
    """Return a PointCloud2 with every `step`-th point and all its fields, in one row."""
    size, count = cloud.point_step, cloud.height * cloud.width
    # As in read_point_cloud2: drivers leave row_step unset, or wrong, in clouds of one row.
    row = cloud.row_step if cloud.height > 1 and cloud.row_step else cloud.width * size
    if row < cloud.width * size or (count and (cloud.height - 1) * row + cloud.width * size > len(cloud.data)):
        raise ValueError(f"{count} points of {size} bytes do not fit into {len(cloud.data)} bytes")
    table = np.ndarray((cloud.height, cloud.width, size), np.uint8, cloud.data, 0, (row, size, 1))
    points = table.reshape(-1, size)[::step]
    changes = {"height": 1, "width": len(points), "row_step": points.size, "data": points.reshape(-1)}
    return encode_message(dataclasses.replace(cloud, **changes), POINT_CLOUD2)


def _static_transform(parent: str, child: str, pose: Any, stamp: int) -> bytes:
    time = message_type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    x, y, z = map(float, pose.position)
    w, i, j, k = map(float, pose.quaternion)
    transform = message_type("geometry_msgs/msg/Transform")(
        translation=message_type("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
        rotation=message_type("geometry_msgs/msg/Quaternion")(x=i, y=j, z=k, w=w),
    )
    stamped = message_type("geometry_msgs/msg/TransformStamped")(
        header=message_type("std_msgs/msg/Header")(stamp=time, frame_id=parent),
        child_frame_id=child,
        transform=transform,
    )
    return encode_message(message_type(TF_TYPES[0])(transforms=[stamped]), TF_TYPES[0])
