"""One pass over a recording: which topics it has, where its sweeps lie, and all its poses. Sweeps stay on disk."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from aero_viz.errors import UserError
from aero_viz.recordings.bagfile import BagFile, Message
from aero_viz.recordings.clouds import CLOUD_TYPES, DamagedMessage, cloud_layout
from aero_viz.recordings.messages import POSE_TYPES, TF_TYPES, decode_poses
from aero_viz.recordings.storage import Storage
from aero_viz.recordings.transforms import Samples, TransformTree

__all__ = ["CloudEntry", "Contents", "Topic", "TopicContents", "read_contents"]

ENCODINGS = ("cdr", "ros1")


class Topic(NamedTuple):
    """A topic as reported to the user."""

    name: str
    type: str
    count: int


class CloudEntry(NamedTuple):
    """Where one cloud lies."""

    stamp: int
    """Time in the header [ns], 0 where unset."""
    arrival: int
    """When it was recorded [ns]."""
    count: int
    """Number of points, invalid ones included."""
    frame: str
    file: BagFile
    position: Any

    @property
    def time(self) -> int:
        """The header's time or, where the driver set none, the time of arrival [ns]."""
        return self.stamp or self.arrival


@dataclass
class TopicContents:
    """What one topic brought."""

    name: str
    type: str
    encoding: str
    count: int = 0
    damaged: int = 0
    """Messages that cannot be decoded."""
    reason: str = ""
    """Why the first of them cannot."""
    clouds: list[CloudEntry] = field(default_factory=list)
    poses: Samples = field(default_factory=Samples)
    child: str = ""
    """Frame whose poses these are, empty where the messages do not say."""


@dataclass
class Contents:
    """What a recording holds."""

    path: Path
    topics: list[TopicContents]
    transforms: TransformTree
    first: int | None
    """Time of the first message [ns], None without messages."""
    last: int | None
    problems: list[str]

    @property
    def duration(self) -> float:
        """Time from the first to the last message [s]."""
        return 0.0 if self.first is None or self.last is None else (self.last - self.first) * 1e-9

    def of_types(self, types: tuple[str, ...]) -> list[TopicContents]:
        """Return the topics of these types that have messages, in the order of the types, busiest first."""
        found = [topic for topic in self.topics if topic.type in types and topic.count]
        return sorted(found, key=lambda topic: (types.index(topic.type), -topic.count, topic.name))


def read_contents(storage: Storage) -> Contents:
    """Scan all files of a recording.

    Damaged messages are counted and left out. Raises UserError when nothing at all can be read.
    """
    wanted = {*CLOUD_TYPES, *POSE_TYPES, *TF_TYPES}
    topics: dict[tuple[str, str], TopicContents] = {}
    contents = Contents(storage.path, [], TransformTree(), None, None, list(storage.problems))
    for file in storage.files:
        count = 0
        for count, message in enumerate(file.scan(wanted), start=1):  # noqa: B007
            channel = message.channel
            topic = topics.get(channel[:2])
            if topic is None:
                topic = topics[channel[:2]] = TopicContents(*channel)
            topic.count += 1
            if not 0 <= message.time < 1 << 63:
                _damaged(topic, "its time is impossible")
                continue
            contents.first = message.time if contents.first is None else min(contents.first, message.time)
            contents.last = message.time if contents.last is None else max(contents.last, message.time)
            if channel.type in wanted:
                _take(message, file, topic, contents.transforms)
        for channel in file.channels.values():
            topics.setdefault(channel[:2], TopicContents(*channel))
        name = getattr(file, "path", storage.path).name
        contents.problems += [f"{name} is {problem}" for problem in file.problems]
        if file.truncated:
            whole = f"{count} messages are" if count > 1 else "one message is" if count else "no message is"
            contents.problems.append(f"{name} is truncated, its end is missing: {whole} whole before the cut")
        if file.damaged:
            contents.problems.append(f"{file.damaged} damaged records or blocks of {name} are left out")
    contents.topics = sorted(topics.values(), key=lambda topic: topic.name)
    for topic in contents.topics:
        if topic.damaged:
            contents.problems.append(
                f"{topic.damaged} of {topic.count} messages on {topic.name} are left out: the first cannot be used "
                f"because {topic.reason}"
            )
    if not contents.topics and contents.problems:
        problems = "; ".join(contents.problems)
        raise UserError(f"nothing can be read from {storage.path}: {problems}; record or copy it again")
    return contents


def _damaged(topic: TopicContents, reason: str) -> None:
    topic.damaged += 1
    topic.reason = topic.reason or reason


def _take(message: Message, file: BagFile, topic: TopicContents, transforms: TransformTree) -> None:
    channel = message.channel
    if channel.encoding not in ENCODINGS:
        _damaged(topic, f"its encoding is {channel.encoding or 'not given'}, not CDR or ROS 1")
        return
    try:
        if channel.type in CLOUD_TYPES:
            layout = cloud_layout(message.head, message.size, channel.type, channel.encoding)
            entry = CloudEntry(layout.stamp, message.time, layout.count, layout.frame, file, message.position)
            topic.clouds.append(entry)
            return
        data = message.head if len(message.head) == message.size else file.read(message.position)
        poses = decode_poses(data, channel.type, channel.encoding)
    except DamagedMessage as error:
        _damaged(topic, str(error))
        return
    except ValueError:
        _damaged(topic, "its bytes are damaged")
        return
    if not all(pose.valid for pose in poses):
        _damaged(topic, "its position or quaternion is not valid")
    static = channel.topic.endswith("tf_static")
    for pose in poses:
        if not pose.valid:
            continue
        if pose.child and channel.type in (*TF_TYPES, POSE_TYPES[3]):
            transforms.add(pose.parent, pose.child, pose.stamp, message.time, pose.values[:7], static=static)
        if channel.type in POSE_TYPES:
            topic.poses.add(pose.stamp, message.time, pose.values)
            topic.child = pose.child
