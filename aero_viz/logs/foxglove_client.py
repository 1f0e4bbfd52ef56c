"""One client of the server for Foxglove, its subscriptions, and the messages that wait for it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.user_file import parse_json

_WAITING_MAX = 16 << 20  # [bytes]
_SUBSCRIPTIONS_MAX = 1000
_DATA = struct.Struct("<BIQ")  # opcode 1, number of the subscription, stamp [ns]


@dataclass
class Channel:
    """A topic that clients can subscribe to."""

    number: int
    topic: str
    kind: str
    """Name of the ROS message, such as nav_msgs/msg/Odometry."""
    last: tuple[bytes, int]
    """The last message and its stamp [ns]."""


class FoxgloveClient:
    """Speaks Foxglove's protocol with one client, on the event loop of the server. Clients number their subscriptions.

    Args:
        connection: the open connection.
        channels: all channels by their number; the server adds to it.
        session: name of the flight, by which a client knows it again after a lost connection.
    """

    def __init__(self, connection: ServerConnection, channels: dict[int, Channel], session: str) -> None:
        self._connection, self._channels = connection, channels
        self._subscriptions: dict[int, int] = {}
        self._waiting: deque[str | bytes] = deque()
        self._size = 0
        self._is_waiting = asyncio.Event()
        greeting = {"op": "serverInfo", "name": "AERO-Viz", "capabilities": [], "metadata": {}, "sessionId": session}
        self._put(json.dumps(greeting))
        self.advertise(channels.values())

    @property
    def is_watching(self) -> bool:
        """True if the client subscribes to a topic."""
        return bool(self._subscriptions)

    async def run(self) -> None:
        """Serve the client until it leaves."""
        sender = asyncio.create_task(self._send())
        try:
            async for message in self._connection:
                if isinstance(message, str):
                    self._receive(message)
        finally:
            sender.cancel()

    def advertise(self, channels: Iterable[Channel]) -> None:
        """Advertise channels to the client."""
        described = [
            {"id": channel.number, "topic": channel.topic, "schemaName": channel.kind, "encoding": "cdr"}
            | {"schemaEncoding": "ros2msg", "schema": DEFINITIONS[channel.kind]}
            for channel in channels
        ]
        self._put(json.dumps({"op": "advertise", "channels": described}))

    def publish(self, channel: Channel) -> None:
        """Send the last message of a channel, if the client has subscribed to it."""
        for subscription, number in self._subscriptions.items():
            if number == channel.number:
                self._put_last(subscription, channel)

    def _put_last(self, subscription: int, channel: Channel) -> None:
        data, stamp = channel.last
        self._put(_DATA.pack(1, subscription, stamp) + data)

    def _put(self, message: str | bytes) -> None:
        if self._size > _WAITING_MAX:  # the client is too slow: it loses what waits, but no channel
            self._waiting = deque(item for item in self._waiting if isinstance(item, str))
            self._size = 0
        self._waiting.append(message)
        self._size += len(message)
        self._is_waiting.set()

    async def _send(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while await self._is_waiting.wait():
                self._is_waiting.clear()
                while self._waiting:
                    message = self._waiting.popleft()
                    self._size = max(self._size - len(message), 0)
                    await self._connection.send(message)

    def _receive(self, text: str) -> None:
        """Carry out a request of the client; only subscriptions are accepted."""
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
            request = parse_json(text)
            for number in request.get("subscriptionIds", ()):
                self._subscriptions.pop(number, None)
            for item in request.get("subscriptions", ()):
                if len(self._subscriptions) < _SUBSCRIPTIONS_MAX and 0 <= item["id"] < 1 << 32:
                    self._subscriptions[int(item["id"])] = self._channels[item["channelId"]].number
                    self._put_last(int(item["id"]), self._channels[item["channelId"]])
