"""One pass over a recording that finds its topics, its sweeps and all its poses. Sweeps stay on disk."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from aero_viz.errors import UserError
from aero_viz.input_limits import TOPICS_MAX
from aero_viz.recordings.bag_file import HEAD_BYTES, BagFile, Message
from aero_viz.recordings.clouds import CLOUD_TYPES, read_cloud
from aero_viz.recordings.depth_image import CAMERA_INFO, IMAGE, Intrinsics, read_camera_info
from aero_viz.recordings.foxglove_cloud import FOXGLOVE_CLOUD
from aero_viz.recordings.pose_messages import POSE_TYPES, TRANSFORM_STAMPED, decode_poses
from aero_viz.recordings.ros_messages import ENCODINGS, TF_TYPES, DamagedMessage
from aero_viz.recordings.storage import Storage
from aero_viz.recordings.transforms import PoseSamples, TransformTree


@dataclass(frozen=True)
class Topic:
    """A topic as reported to the user."""

    name: str
    type: str
    count: int
    """Number of messages."""


@dataclass(frozen=True, slots=True)
class CloudEntry:
    """Location of a cloud in the recording."""

    stamp: int
    """Time in the header [ns], 0 where unset."""
    arrival: int
    """Time of recording [ns]."""
    count: int
    """Number of points, invalid ones included."""
    frame: str
    """Frame of the coordinates."""
    file: BagFile
    position: Any
    """Argument of `BagFile.read`."""
    sensor: str = ""
    """Name of the sensor, where the message has one besides its frame."""
    camera: Intrinsics | None = None
    """Intrinsics of the camera of a depth image."""

    @property
    def time(self) -> int:
        """The stamp or, where the driver set none, the time of recording [ns]."""
        return self.stamp or self.arrival


@dataclass
class TopicContents:
    """The messages of one topic."""

    name: str
    type: str
    encoding: str
    count: int = 0
    """Number of messages."""
    damaged: int = 0
    """Number of messages that cannot be decoded."""
    reason: str = ""
    """Reason why the first of them cannot be decoded."""
    clouds: list[CloudEntry] = field(default_factory=list)
    poses: dict[tuple[str, str], PoseSamples] = field(default_factory=dict)
    """By the frame that they are in and the frame that they place, which is empty where the messages do not say."""

    def add_damaged(self, reason: str) -> None:
        """Count a message that cannot be decoded."""
        self.damaged += 1
        self.reason = self.reason or reason


@dataclass
class Contents:
    """Everything in a recording except the points."""

    path: Path
    topics: list[TopicContents]
    transforms: TransformTree
    first: int | None
    """Time of the first message [ns], None without messages."""
    last: int | None
    """Time of the last message [ns], None without messages."""
    problems: list[str]
    """Notices for the user, one sentence each."""

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s]."""
        return 0.0 if self.first is None or self.last is None else (self.last - self.first) * 1e-9

    def topics_with(self, types: tuple[str, ...]) -> list[TopicContents]:
        """Return the topics that have messages of `types`, in the order of the types, the busiest topic first."""
        found = [topic for topic in self.topics if topic.type in types and topic.count]
        return sorted(found, key=lambda topic: (types.index(topic.type), -topic.count, topic.name))


def read_contents(storage: Storage) -> Contents:
    """Scan all files of a recording. Damaged messages are counted and left out.

    Raises:
        UserError: nothing can be read.
    """
    scanner = _Scanner(storage)
    for file in storage.files:
        scanner.scan(file)
    scanner.join_cameras()
    contents = scanner.contents
    contents.topics = sorted(scanner.topics.values(), key=lambda topic: topic.name)
    for topic in contents.topics:
        if topic.damaged:
            contents.problems.append(
                f"{topic.damaged} of {topic.count} messages on {topic.name} are left out: the first cannot be used "
                f"because {topic.reason}"
            )
    if not contents.topics and contents.problems:
        problems = "; ".join(contents.problems)
        raise UserError(f"Nothing can be read from {storage.path}: {problems}; record or copy it again.")
    return contents


class _Scanner:
    """Collects the contents of one file after the other."""

    def __init__(self, storage: Storage) -> None:
        self.contents = Contents(storage.path, [], TransformTree(), None, None, list(storage.problems))
        self.topics: dict[tuple[str, str], TopicContents] = {}
        """By name and type."""
        self._types = {*CLOUD_TYPES, *POSE_TYPES, *TF_TYPES, CAMERA_INFO}
        self._cameras: dict[str, Intrinsics] = {}
        """By the namespace of the topic."""
        self._surplus = 0
        self._padded = np.zeros(HEAD_BYTES, np.uint8)

    def scan(self, file: BagFile) -> None:
        """Add the messages of a file, and the problems found in it."""
        contents, count = self.contents, 0
        for message in file.scan(self._types):
            count += 1
            key = message.channel[:2]
            topic = self.topics.get(key)
            if topic is None and len(self.topics) >= TOPICS_MAX:
                self._surplus += 1
                continue
            if topic is None:
                topic = self.topics[key] = TopicContents(*message.channel)
            topic.count += 1
            if not 0 <= message.time < 1 << 63:
                topic.add_damaged("its time is impossible")
                continue
            contents.first = message.time if contents.first is None else min(contents.first, message.time)
            contents.last = message.time if contents.last is None else max(contents.last, message.time)
            if message.channel.type in self._types:
                self._add(message, file, topic)
        for channel in islice(file.channels.values(), TOPICS_MAX):
            self.topics.setdefault(channel[:2], TopicContents(*channel))
        name = file.path.name
        contents.problems += [f"{name} is {problem}" for problem in file.problems]
        if file.truncated:
            precede = "1 message precedes" if count == 1 else f"{count or 'no'} messages precede"
            contents.problems.append(f"{name} is truncated: {precede} the cut")
        if self._surplus:
            contents.problems.append(
                f"{name} has more than {TOPICS_MAX} topics: {self._surplus} messages on the others are left out"
            )
            self._surplus = 0
        if file.damaged:
            contents.problems.append(f"{file.damaged} damaged records or chunks of {name} are left out")

    def join_cameras(self) -> None:
        """Give depth images the intrinsics that a topic in their namespace has; those without are no clouds."""
        for topic in self.topics.values():
            if topic.type == IMAGE and topic.clouds:
                camera = self._cameras.get(_namespace(topic.name))
                topic.clouds = [] if camera is None else [replace(entry, camera=camera) for entry in topic.clouds]
                if camera is None:
                    topic.add_damaged(f"no CameraInfo on {_namespace(topic.name)}/camera_info says how a pixel looks")

    def _add(self, message: Message, file: BagFile, topic: TopicContents) -> None:
        """Add a cloud or the poses of a message."""
        channel = message.channel
        if channel.encoding not in ENCODINGS and channel.type != FOXGLOVE_CLOUD:
            topic.add_damaged(f"its encoding is {channel.encoding or 'not given'}, not CDR or ROS 1")
            return
        try:
            if channel.type == CAMERA_INFO:
                if (name := _namespace(channel.topic)) not in self._cameras:
                    self._cameras[name] = read_camera_info(file.read(message.position), channel.encoding)
                return
            if channel.type in CLOUD_TYPES:
                is_text = channel.encoding == "json"
                layout = file.read(message.position) if is_text else self._without_points(message)
                cloud = read_cloud(layout, channel.type, channel.encoding)
                entry = CloudEntry(
                    cloud.stamp, message.time, cloud.rows.size, cloud.frame, file, message.position, cloud.sensor
                )
                topic.clouds.append(entry)
                notice = f"clouds on {topic.name}: {cloud.notice}" if cloud.notice else ""
                if notice and notice not in self.contents.problems:
                    self.contents.problems.append(notice)
                return
            data = message.head if len(message.head) == message.size else file.read(message.position)
            poses = decode_poses(data, channel.type, channel.encoding)
        except DamagedMessage as error:
            if channel.type == IMAGE and not topic.clouds:  # most images hold no depth, and nobody expects it
                topic.reason = str(error)
            else:
                topic.add_damaged(str(error))
            return
        except ValueError:
            topic.add_damaged("its bytes are damaged")
            return
        if defect := next((pose.defect for pose in poses if pose.defect), ""):
            topic.add_damaged(defect)
        static = channel.topic.endswith("tf_static")
        for pose in poses:
            if pose.defect:
                continue
            if pose.child and channel.type in (*TF_TYPES, TRANSFORM_STAMPED):
                self.contents.transforms.add(
                    pose.parent, pose.child, pose.stamp, message.time, pose.values[:7], static=static
                )
            if channel.type in POSE_TYPES:
                samples = topic.poses.setdefault((pose.parent, pose.child), PoseSamples())
                samples.add(pose.stamp, message.time, pose.values)

    def _without_points(self, message: Message) -> bytes | memoryview:
        """Return the message with zeros behind its head, from which the layout of a cloud can be decoded.

        Reading the points of a long recording only to count them would take minutes.
        """
        if len(message.head) == message.size:
            return message.head
        if len(self._padded) < message.size:
            self._padded = np.zeros(2 * message.size, np.uint8)  # pages that are never written take no memory
        self._padded[: len(message.head)] = np.frombuffer(message.head, np.uint8)
        return self._padded[: message.size].data


def _namespace(topic: str) -> str:
    """Return the name of a topic up to its last part."""
    return topic.rpartition("/")[0]
