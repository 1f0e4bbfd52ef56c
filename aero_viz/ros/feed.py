"""Topics of a graph that feed a stream: only those that are used, whoever publishes them, whenever they come."""

from __future__ import annotations

import functools
import logging
import threading
from collections.abc import Mapping
from typing import Any, NamedTuple

from aero_viz.errors import UserError
from aero_viz.live.source import GOAL_TYPES
from aero_viz.live.stream import Stream
from aero_viz.recordings.clouds import CLOUD_TYPES
from aero_viz.recordings.depth_image import CAMERA_INFO
from aero_viz.recordings.imu_messages import IMU_TYPE
from aero_viz.recordings.pose_messages import POSE_TYPES
from aero_viz.recordings.ros_messages import TF_TYPES
from aero_viz.recordings.topics import check_topic
from aero_viz.ros.graph import Graph, Quality, Topic, message_class

_log = logging.getLogger(__name__)

READ_TYPES = (*CLOUD_TYPES, *POSE_TYPES, *TF_TYPES, CAMERA_INFO, IMU_TYPE, *GOAL_TYPES)
"""Types of the topics that are read."""

_PERIOD = 0.5
"""Time between two looks at the graph [s]."""
_DEPTH = 100
"""Messages that may wait: poses come 200 times a second."""
_CLOUDS = 20
"""Clouds that may wait."""


class _Subscribed(NamedTuple):
    subscription: Any
    type: str
    quality: Quality | None


class Feed:
    """Subscribes to topics for a stream, and again where their publishers ask for another quality of service.

    Args:
        graph: the graph; closed by its owner, after this.
        stream: takes the messages.
    """

    def __init__(self, graph: Graph, stream: Stream) -> None:
        self.graph = graph
        """The graph."""
        self._stream = stream
        self._wanted: dict[str, str] = {}
        self._subscribed: dict[str, _Subscribed] = {}
        self._rests = False
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="aero-viz-ros-feed", daemon=True)
        self._watcher.start()

    def candidates(self) -> dict[str, str]:
        """Return the topics of the graph that can be read, with their types."""
        found: dict[str, str] = {}
        for topic in self.graph.topics():
            if (kind := readable_type(topic)) is not None:
                found[topic.name] = kind
        return found

    def check(self, name: str, role: str) -> None:
        """Raise UserError if a topic is not published, or not in a type for its role; see `check_topic`."""
        present = [(topic.name, kind) for topic in self.graph.topics() for kind in topic.types]
        check_topic(name, role, present, self._stream.name)

    @property
    def topics(self) -> dict[str, str]:
        """The topics that are subscribed to, with their types."""
        return {name: subscribed.type for name, subscribed in tuple(self._subscribed.items())}

    def use(self, topics: Mapping[str, str]) -> None:
        """Subscribe to these topics, by name and type, and to no others.

        A topic need not exist yet. If it is then published in another type that is read, it is subscribed to in that.

        Raises:
            UserError: a type is not installed.
        """
        for kind in topics.values():
            message_class(kind)
        with self._lock:
            self._wanted = dict(topics)
            self._update()

    def rest(self, rests: bool) -> None:
        """Unsubscribe from the clouds while nobody uses them: they take most of the network and of the processor."""
        with self._lock:
            if self._rests and not rests:
                self._stream.interrupt(self._wanted.keys() - self._subscribed.keys())
            self._rests = rests
            self._update()

    def _watch(self) -> None:
        while not self._closed.wait(_PERIOD):
            with self._lock:
                try:
                    if not self._closed.is_set():
                        self._update()
                except Exception as error:  # rclpy has not let go of a topic's other type yet, for example
                    _log.info("the topics of ROS 2 are looked at again: %s", error)

    def _update(self) -> None:
        """Remove what is not wanted, and subscribe where nothing is subscribed, or with another quality."""
        wanted = {name: kind for name, kind in self._wanted.items() if not (self._rests and kind in CLOUD_TYPES)}
        for name in [name for name in self._subscribed if name not in wanted]:
            self.graph.remove(self._subscribed.pop(name).subscription)
        for name, expected in wanted.items():
            kind = self._type(name, expected)
            quality, present = self.graph.quality(name, kind), self._subscribed.get(name)
            self._stream.health(name, kind).publishers = tuple(self.graph.nodes(name))
            # Without a publisher, the subscription waits for one that returns.
            if present is not None and present.type == kind and quality in (None, present.quality):
                continue
            if present is not None:
                self.graph.remove(self._subscribed.pop(name).subscription)
            take = functools.partial(self._stream.add, name, kind)
            depth = _CLOUDS if kind in CLOUD_TYPES else _DEPTH
            subscription = self.graph.subscribe(name, kind, take, raw=True, depth=depth)
            self._subscribed[name] = _Subscribed(subscription, kind, quality)

    def _type(self, name: str, expected: str) -> str:
        """Return the type in which a topic is read: as it is published, and without a publisher as before."""
        types, present = self.graph.types(name), self._subscribed.get(name)
        if not types:
            return expected if present is None else present.type
        if expected in types:
            return expected
        return readable_type(Topic(name, tuple(types), 1)) or expected

    def close(self) -> None:
        """Unsubscribe from everything."""
        self._closed.set()
        self._watcher.join()
        with self._lock:
            self._wanted = {}
            self._update()


def readable_type(topic: Topic) -> str | None:
    """Return the type by which a topic is read, None if it is of no use or its type is not installed."""
    for kind in topic.types:
        if kind in READ_TYPES:
            try:
                message_class(kind)
            except UserError:
                continue
            return kind
    return None


def missing_package(topic: Topic) -> str | None:
    """Return the package of messages without which a topic cannot be read; None if it is no package that is missing."""
    kinds = [kind for kind in topic.types if kind in READ_TYPES]
    return kinds[0].split("/")[0] if kinds and readable_type(topic) is None else None
