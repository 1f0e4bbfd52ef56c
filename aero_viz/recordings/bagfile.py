"""What the readers of all file formats have in common: channels, messages, and files made of blocks of records."""

from __future__ import annotations

import mmap
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

__all__ = [
    "HEAD_BYTES",
    "ZSTD_MAGIC",
    "BagFile",
    "BlockFile",
    "Channel",
    "Message",
    "checked_channel",
    "expand",
    "unwrap",
]

HEAD_BYTES = 4096
"""Bytes of a wanted message handed out while scanning: enough for the layout of a cloud and for a whole pose."""

_LARGEST_BLOCK = 1 << 31
"""A block that claims to expand to more bytes is damaged, or an attempt to exhaust the memory."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Start of a zstd frame: of a whole compressed file, or of one compressed message."""


class Channel(NamedTuple):
    """One publisher's stream of messages."""

    topic: str
    type: str
    """Full name such as sensor_msgs/msg/PointCloud2, also for ROS 1."""
    encoding: str
    """"cdr" (ROS 2), "ros1", or another word for messages that cannot be decoded here."""


class Message(NamedTuple):
    """One message as met while scanning a file."""

    channel: Channel
    time: int
    """When it was recorded [ns]."""
    position: Any
    """Where it lies; `BagFile.read` takes it."""
    size: int
    """Length of the whole message [bytes]."""
    head: bytes
    """Its first `HEAD_BYTES` bytes, empty when its type was not wanted."""


class BagFile(Protocol):
    """One file of a recording. Opening reads nothing but the magic; `scan` is the one pass over the file."""

    problems: list[str]
    """What `scan` found wrong, one clause each."""
    truncated: bool
    """Whether `scan` came to an end before the file's own."""
    channels: dict[int, Channel]
    """Channels declared so far, by their number in the file."""
    damaged: int
    """Records and blocks that could not be read."""

    def scan(self, wanted: Collection[str]) -> Iterator[Message]:
        """Yield every message in the order of the file; stops where a truncated file stops."""
        ...

    def read(self, position: Any) -> bytes:
        """Return the whole message at a position that `scan` gave."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def checked_channel(topic: str, kind: str, encoding: str) -> Channel:
    """Return a channel with its type in full; raises ValueError for names that only damage can have made."""
    if not (topic + kind + encoding).isprintable():
        raise ValueError("a channel's name is damaged")
    return Channel(topic, _normalised_type(kind), encoding)


def _normalised_type(name: str) -> str:
    """Return pkg/msg/Type for pkg/Type, as ROS 2 spells it."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


def unwrap(data: bytes) -> bytes:
    """Return a message as it was published: rosbag2's message compression wraps each in a zstd frame.

    A CDR message starts with a zero byte, so the frame's magic cannot be mistaken for one.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    return expand("zstd", data, _LARGEST_BLOCK - 1, exact=False)


def expand(compression: str, data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Decompress to at most `size` bytes; raises ValueError when the outcome is not `size` long."""
    if size >= _LARGEST_BLOCK:
        raise ValueError(f"a block claims {size} bytes")
    if compression == "zstd":
        import zstandard

        raw = zstandard.ZstdDecompressor().stream_reader(data).read(size)
    elif compression == "lz4":
        import lz4.frame

        raw = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    elif compression == "bz2":
        import bz2

        raw = bz2.BZ2Decompressor().decompress(data, max_length=size)
    else:
        raise ValueError(f"unknown compression {compression!r}")
    if exact and len(raw) != size:
        raise ValueError(f"a block expands to {len(raw)} bytes instead of {size}")
    return raw


class BlockFile:
    """A file that is a run of records, some of which are compressed blocks of records (MCAP, ROS 1).

    The file is mapped, never loaded: a scan touches the records' headers and the wanted messages, except that a
    compressed block has to be expanded as a whole. A position is (block, start, stop), block None for the file itself.
    """

    def __init__(self, path: Path):
        self.path = path
        self.problems: list[str] = []
        self.truncated = False
        self.channels: dict[int, Channel] = {}
        self.damaged = 0
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        # Messages of one sweep and its neighbours share a block; two cover playback across a border.
        self._blocks: dict[int, bytes] = {}

    def read(self, position: tuple[int | None, int, int]) -> bytes:
        """Return the message at a position that `scan` gave; raises ValueError for a damaged block."""
        block, start, stop = position
        return unwrap(self._map[start:stop] if block is None else self.block(block)[start:stop])

    def block(self, offset: int) -> bytes:
        """Return the expanded block whose record starts at byte `offset`; the last two are kept."""
        if offset not in self._blocks:
            raw = self.expand_block(offset)
            while len(self._blocks) > 1:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[offset] = raw
        return self._blocks[offset]

    def expand_block(self, offset: int) -> bytes:
        """Decompress the block whose record starts at byte `offset`."""
        raise NotImplementedError

    def message(self, channel: Channel, time: int, position: tuple[int | None, int, int], buffer,
                wanted: Collection[str]) -> Message:  # fmt: skip
        """Return the message at a position of `buffer`, with its head where the type is wanted."""
        _, start, stop = position
        if channel.type not in wanted:
            return Message(channel, time, position, stop - start, b"")
        head = buffer[start : min(stop, start + HEAD_BYTES)]
        if not head.startswith(ZSTD_MAGIC):
            return Message(channel, time, position, stop - start, head)
        try:
            whole = unwrap(buffer[start:stop])
        except Exception:
            whole = b""
        return Message(channel, time, position, len(whole), whole[:HEAD_BYTES])

    def close(self) -> None:
        """Close the file."""
        self._blocks.clear()
        self._map.close()
