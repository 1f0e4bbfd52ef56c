"""The poses of a recording as messages that take the place of all recorded ones."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from aero_planner import VehicleState
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import BODY, WORLD, Encoded, pose_messages
from aero_planner.quaternions import compose_transforms, invert_transform
from aero_viz.errors import UserError
from aero_viz.recordings.bag_file import Channel
from aero_viz.recordings.contents import Contents
from aero_viz.recordings.pose_messages import POSE_TYPES
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.ros_messages import TF_TYPES, decode_message, encode_message, message_type
from aero_viz.recordings.transforms import FIXED_FRAMES, IDENTITY, Transform

STATIC_DEFINITION = DEFINITIONS[TF_TYPES[0]]


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


class Edge(NamedTuple):
    """A static transform: the pose of the frame `child` in `parent`."""

    parent: str
    child: str
    pose: Transform


class NewPoses:
    """The poses that a recording plays with, if they are not recorded ones, and the mounting of its sensor.

    They are written as /odometry and /tf, in place of all other topics of poses: a reader could not know which of them
    to use. The static transforms from the sensor upwards stay, and the uppermost frame that moves with the sensor is
    mounted on the body. So the frames of other sensors stay joined to it.

    Args:
        recording: has poses.
        contents: the same recording.

    Raises:
        UserError: messages cannot describe these poses.
    """

    def __init__(self, recording: Recording, contents: Contents) -> None:
        self._recording, self._contents = recording, contents
        frame = recording.cloud_frame
        recorded = next((topic for topic in contents.topics_with(POSE_TYPES) if len(topic.poses)), None)
        tracks = () if recorded is None else recorded.poses
        if frame == WORLD or any(parent == frame != child for parent, child in tracks):
            raise UserError(
                f"{recording.pose_topic} cannot be written for {recording.path}: clouds on {recording.points_topic} "
                f"are in the frame of the world, {frame!r}, which no pose of the sensor moves. Play the recording with "
                "these poses instead, or name a topic of clouds in the frame of the sensor with --points-topic."
            )
        mounted = not all(np.allclose(*pair) for pair in zip(recording.extrinsic, IDENTITY, strict=True))
        if mounted and frame in ("", BODY):
            raise UserError(
                f"The mounting of the sensor cannot be written for {recording.path}: the frame of its clouds is "
                f"{frame!r}, which names no sensor. Convert without --extrinsic, and play the new file with it."
            )
        self.mounting = self._edges(frame)
        """Transforms from the body to the sensor."""
        self._placed = {BODY, frame, *(edge.child for edge in self.mounting)}

    def _edges(self, frame: str) -> list[Edge]:
        if frame in ("", BODY):
            return []
        transforms, edges, root = self._contents.transforms, [], frame
        for edge in transforms.chain(frame):
            pose = transforms.between(*edge) if transforms.is_static(edge) else None
            if pose is None or edge[0] in (*FIXED_FRAMES, BODY):
                break
            edges.append(Edge(*edge, pose))
            root = edge[0]
        sensor = transforms.between(root, frame) or IDENTITY
        mount = Transform(*compose_transforms(*self._recording.extrinsic, *invert_transform(*sensor)))
        return [Edge(BODY, root, mount), *edges]

    def replaces(self, channel: Channel) -> bool:
        """Return True for a topic that is left out."""
        is_moving = channel.type in TF_TYPES and not is_static(channel)
        return is_moving or channel.type in POSE_TYPES or channel.topic in ("/odometry", "/tf")

    def without_mounting(self, data: bytes) -> bytes | None:
        """Return a static TFMessage without the transforms that `mounting` replaces; None if it has no others."""
        message = decode_message(data, TF_TYPES[0], "cdr")
        kept = [edge for edge in message.transforms if edge.child_frame_id.lstrip("/") not in self._placed]
        return encode_message(dataclasses.replace(message, transforms=kept), TF_TYPES[0]) if kept else None

    def messages(self, window: Window) -> Iterator[tuple[Encoded, int]]:
        """Yield the messages of the poses in a window, with their times of recording [ns].

        Poses have the clock of the sweeps' stamps, which is not always that of the recording. They are written if they
        lie in the window, or between the sweeps in it, and so are the ones before and after, which the first and the
        last sweep may need.
        """
        poses, start = self._recording.poses, self._recording.start
        assert poses is not None
        stamps = np.array([start + round(1e9 * float(time)) for time in poses.times], np.int64)
        offset, span = self._clock(window)
        limits = min(span.start, window.start - offset), max(span.end, window.end - offset)
        low, high = int((stamps < limits[0]).sum()), int((stamps <= limits[1]).sum())
        if low == high and not poses.covers([1e-9 * (limit - start) for limit in limits if math.isfinite(limit)]).any():
            return
        for i in range(max(low - 1, 0), min(high + 1, len(stamps))):
            state = VehicleState(
                poses.positions[i] + poses.offset, poses.velocities[i], poses.quaternions[i], time=poses.times[i]
            )
            for message in pose_messages(state, int(stamps[i])):
                yield message, window.nearest(int(stamps[i]) + offset)

    def _clock(self, window: Window) -> tuple[int, Window]:
        """Return the time from stamps to times of recording [ns], and the stamps of the sweeps in a window."""
        topics = [topic for topic in self._contents.topics if topic.name == self._recording.points_topic]
        entries = [entry for topic in topics for entry in topic.clouds if entry.count]
        arrivals = np.array([entry.arrival for entry in entries], np.int64)
        times = np.array([entry.time for entry in entries], np.int64)
        start = self._recording.start
        if np.abs(arrivals - start).min() < np.abs(times - start).min():
            times = arrivals  # stamps of the recorded poses do not fit those of the sweeps
        inside = (arrivals >= window.start) & (arrivals <= window.end)
        span = (
            Window(int(times[inside].min()), int(times[inside].max())) if inside.any() else Window(math.inf, -math.inf)
        )
        return int(np.sort(arrivals - times)[len(times) // 2]), span

    def mounting_messages(self) -> Iterator[Encoded]:
        """Yield `mounting` as messages on /tf_static."""
        for edge in self.mounting:
            yield Encoded("/tf_static", TF_TYPES[0], _static_transform(edge, self._recording.start))


def is_static(channel: Channel) -> bool:
    """Return True for a topic of transforms that hold for the whole recording, whenever they are published."""
    return channel.type in TF_TYPES and channel.topic.endswith("tf_static")


def _static_transform(edge: Edge, stamp: int) -> bytes:
    time: Any = message_type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    x, y, z = map(float, edge.pose.position)
    w, i, j, k = map(float, edge.pose.quaternion)
    transform = message_type("geometry_msgs/msg/Transform")(
        translation=message_type("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
        rotation=message_type("geometry_msgs/msg/Quaternion")(x=i, y=j, z=k, w=w),
    )
    stamped = message_type("geometry_msgs/msg/TransformStamped")(
        header=message_type("std_msgs/msg/Header")(stamp=time, frame_id=edge.parent),
        child_frame_id=edge.child,
        transform=transform,
    )
    return encode_message(message_type(TF_TYPES[0])(transforms=[stamped]), TF_TYPES[0])
