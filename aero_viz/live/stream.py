"""Messages as they arrive, from whatever source, and the newest seconds of them as a recording."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from aero_viz.live.health import ArrivalClock, TopicHealth, header_stamp
from aero_viz.recordings.bag_file import HEAD_BYTES, BagFile, Channel, Message
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.depth_image import CAMERA_INFO
from aero_viz.recordings.storage import Storage

_KEPT_SECONDS, _KEPT_BYTES = 20.0, 96 << 20
"""Messages that are kept: for the findings, and as the beginning of a recording [s], [bytes]."""
_LATCHED_MAX = 64
"""Largest number of messages that are kept for good: static transforms and the intrinsics of cameras."""


class LiveMessage(NamedTuple):
    """A message that has arrived."""

    topic: str
    type: str
    time: int
    """Arrival [ns], by `Stream.clock`."""
    data: bytes
    """The message as CDR, as in a recording."""


class Stream:
    """Takes messages from any thread, counts them by topic, and keeps the newest.

    Args:
        name: name for the user.
        seconds, size: what is kept [s], [bytes].
    """

    def __init__(self, name: str, *, seconds: float = _KEPT_SECONDS, size: int = _KEPT_BYTES) -> None:
        self.name = name
        self.clock = ArrivalClock()
        """Clock of the arrivals."""
        self.topics: dict[str, TopicHealth] = {}
        """The topics so far by name; only grows."""
        self._seconds, self._size = seconds, size
        self._newest: deque[LiveMessage] = deque()
        self._bytes = 0
        self._latched: dict[tuple[str, int], LiveMessage] = {}
        self._listeners: tuple[Callable[[LiveMessage], None], ...] = ()
        self._lock = threading.Lock()

    def add(self, topic: str, type_name: str, data: bytes, *, time: int | None = None) -> None:
        """Take a message.

        Args:
            topic: its topic.
            type_name: its type, such as sensor_msgs/msg/PointCloud2.
            data: the message as CDR.
            time: arrival [ns]; None is now.
        """
        message = LiveMessage(topic, type_name, self.clock.now() if time is None else time, data)
        with self._lock:
            self.health(topic, type_name).add(header_stamp(data, type_name), message.time)
            if topic.endswith("tf_static") or type_name == CAMERA_INFO:
                # The same transforms with another stamp are the same.
                key = (topic, hash(data[16:]) if type_name != CAMERA_INFO else 0)
                if key in self._latched or len(self._latched) < _LATCHED_MAX:
                    self._latched[key] = message
            else:
                self._keep(message)
            # Under the lock, so that a recorder that is added has every message once.
            for listener in self._listeners:
                listener(message)

    def health(self, topic: str, type_name: str) -> TopicHealth:
        """Return the counts of a topic, which begin with the first call."""
        return self.topics.setdefault(topic, TopicHealth(topic, type_name))

    def interrupt(self, topics: Collection[str]) -> None:
        """Forget the messages so far: some topics were not listened to, which is no fault of theirs."""
        with self._lock:
            self._newest.clear()
            self._bytes = 0
            for topic in self.topics.keys() & topics:
                self.topics[topic].interrupt()

    def _keep(self, message: LiveMessage) -> None:
        self._newest.append(message)
        self._bytes += len(message.data)
        oldest = message.time - round(1e9 * self._seconds)
        while len(self._newest) > 1 and (self._bytes > self._size or self._newest[0].time < oldest):
            self._bytes -= len(self._newest.popleft().data)

    def messages(self) -> list[LiveMessage]:
        """Return what is kept, in the order of arrival, behind what was published once."""
        with self._lock:
            return [*self._latched.values(), *self._newest]

    def listen(self, listener: Callable[[LiveMessage], None], *, from_kept: bool = False) -> Callable[[], None]:
        """Call `listener` with every message, on the thread that adds it, until the returned function is called.

        Args:
            listener: must return at once.
            from_kept: call it with what is kept first.
        """
        with self._lock:
            if from_kept:
                for message in (*self._latched.values(), *self._newest):
                    listener(message)
            self._listeners = (*self._listeners, listener)

        def end() -> None:
            with self._lock:
                self._listeners = tuple(kept for kept in self._listeners if kept is not listener)

        return end

    def storage(self, choices: Choices = AUTOMATIC) -> Storage:
        """Return what is kept, as the storage of a recording."""
        path = Path(self.name)
        storage = Storage(path, [], is_folder=False, choices=choices)
        storage.files.append(_Kept(path, self.messages()))
        storage.format = "live"
        return storage


class _Kept(BagFile):
    """Messages in memory, read like those of a file."""

    def __init__(self, path: Path, messages: list[LiveMessage]) -> None:
        super().__init__(path)
        self._messages = messages
        names = dict.fromkeys((message.topic, message.type) for message in messages)
        self.channels = {number: Channel(*name, "cdr") for number, name in enumerate(names)}

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        channels = {channel[:2]: channel for channel in self.channels.values()}
        for number, message in enumerate(self._messages):
            channel, data = channels[message.topic, message.type], message.data
            head = data[:HEAD_BYTES] if message.type in types else b""
            yield Message(channel, message.time, number, len(data), head)

    def read(self, position: Any) -> bytes:
        return self._messages[position].data

    def close(self) -> None:
        self._messages = []
