"""Writes a recording, or a part of it, as ROS 2 MCAP that Foxglove, RViz and rosbags open."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import Encoded
from aero_planner.output_files import whole_file
from aero_viz.errors import UserError
from aero_viz.point_times import point_times
from aero_viz.recordings.bag_file import BagFile, Channel, Message, one_line
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.cloud_files import CloudSequence
from aero_viz.recordings.clouds import CLOUD_TYPES, read_cloud
from aero_viz.recordings.contents import read_contents
from aero_viz.recordings.convert_poses import STATIC_DEFINITION, NewPoses, Window, is_static
from aero_viz.recordings.depth_image import IMAGE
from aero_viz.recordings.opening import configure_recording
from aero_viz.recordings.other_clouds import LASER_SCAN
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, checked_row_step, encode_point_cloud2
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.ros_messages import (
    ENCODINGS,
    TF_TYPES,
    decode_message,
    encode_message,
    message_definition,
    ros1_to_cdr,
)
from aero_viz.recordings.storage import Storage, open_storage, readable
from aero_viz.text_table import format_size

_COPIED = (POINT_CLOUD2, LASER_SCAN, IMAGE)
"""Types of clouds that are written as they are."""


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
    choices: Choices = AUTOMATIC,
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
        recording: the opened recording; None opens it. If its poses are estimated or from a file, which may lie next
            to the clouds, they are written as /odometry and /tf, in place of all recorded ones.
        choices: what the user has settled about the recording.
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
    storage = open_storage(source, choices)
    try:
        with readable(storage.path):
            contents = read_contents(storage)
            if recording is None and storage.pose_file is not None:
                recording = Recording(storage, contents, None, None)
                configure_recording(recording, storage, contents)
        refuse_source(target, storage)
        unknown = sorted(set(topics) - {topic.name for topic in contents.topics})
        if unknown:
            names = ", ".join(topic.name for topic in contents.topics)
            raise UserError(f"{source} has no topic {', '.join(unknown)}; it has {names}.")
        first = contents.first or 0
        window = Window.after(first, start, end)
        try:
            with whole_file(target, alone=True) as partial, partial.open("wb") as file:
                output = _Output(Writer(file, compression=CompressionType.ZSTD), decimate, first)
                if recording is not None and has_new_poses(recording):
                    output.write_poses(NewPoses(recording, contents), window)
                elif recording is not None and recording.poses is not None:
                    output.notes.append(f"poses are recorded on {recording.pose_topic}: no others are written")
                if recording is not None and recording.changes[-1]:
                    output.notes.append("the points in the mask are written: play the file with the same --mask")
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


def has_new_poses(recording: Recording) -> bool:
    """Return True for a recording that plays with other poses than recorded ones, which `convert` writes."""
    return recording.pose_origin in ("file", "odometry")


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
        first: time of recording of the first message [ns].
    """

    def __init__(self, writer: Writer, decimate: int, first: int) -> None:
        self.counts: dict[str, int] = {}
        self.left_out: dict[str, str] = {}
        self.notes: list[str] = []
        """Differences of what was written, one sentence each."""
        self.is_empty = True
        """True until a message was written that was asked for, which those on /tf_static are not in every case."""
        self._damaged: dict[str, list[str]] = {}
        """Reasons why messages could not be read, by topic."""
        self._writer, self._decimate, self._first = writer, decimate, first
        self._channels: dict[tuple[str, str], int] = {}
        self._new_poses: NewPoses | None = None
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
            if self._new_poses is not None and self._new_poses.replaces(channel):
                self.left_out[channel.topic] = "other poses take its place"
                continue
            progress(message.time)
            if self._copy_message(bag, message, window.nearest(message.time)):
                self.is_empty &= not is_chosen

    def _copy_message(self, bag: BagFile, message: Message, time: int) -> bool:
        """Write a message with a time of recording [ns], and return whether it was written."""
        channel = message.channel
        kind = TF_TYPES[0] if channel.type in TF_TYPES else channel.type
        kind = POINT_CLOUD2 if kind in CLOUD_TYPES and kind not in _COPIED else kind
        definition = _definition(kind) or bag.definitions.get(channel.type)
        if channel.encoding not in ENCODINGS and channel.type not in CLOUD_TYPES:
            self.left_out[channel.topic] = f"its encoding is {channel.encoding or 'not given'}, not CDR or ROS 1"
            return False
        if definition is None or (channel.encoding == "ros1" and not _definition(kind)):
            self.left_out[channel.topic] = f"the type {channel.type} is not known here"
            return False
        try:
            data = self._converted(bag.read(message.position), channel)
            if self._new_poses is not None and is_static(channel):
                data = self._new_poses.without_mounting(data)
        except Exception as error:  # decompressors and SQLite fail in many ways; the other messages are fine
            self._damaged.setdefault(channel.topic, []).append(one_line(error))
            return False
        if data is None:
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

    def write_poses(self, poses: NewPoses, window: Window) -> None:
        """Write poses in place of the recorded ones, which are not copied any more."""
        self._new_poses = poses
        for message, time in poses.messages(window):
            self._add(message, time, DEFINITIONS[message.kind])
            self.is_empty = False
        if self.is_empty:
            self.notes.append("the poses do not reach the chosen part of the recording: none is written")
        for message in poses.mounting_messages():
            self._add(message, window.nearest(self._first), STATIC_DEFINITION)

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
    size = cloud.point_step
    strides = (checked_row_step(cloud), size, 1)
    table = np.ndarray((cloud.height, cloud.width, size), np.uint8, cloud.data, 0, strides)
    points = table.reshape(-1, size)[::step]
    changes = {"height": 1, "width": len(points), "row_step": points.size, "data": points.reshape(-1)}
    return encode_message(dataclasses.replace(cloud, **changes), POINT_CLOUD2)
