"""The base of all file readers, and the base of those whose files consist of chunks of records."""

from __future__ import annotations

import mmap
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

__all__ = [
    "HEAD_BYTES",
    "ZSTD_MAGIC",
    "BagFile",
    "Buffer",
    "Channel",
    "ChunkPosition",
    "ChunkedFile",
    "Message",
    "decompress",
    "make_channel",
    "unwrap",
]

HEAD_BYTES = 4096
"""Length of a message's head [bytes]: enough for the layout of a cloud and for a whole pose."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Start of a zstd frame, which holds a whole compressed file or one compressed message."""

_MAX_DECOMPRESSED = 1 << 31
"""A chunk that claims to be larger [bytes] is damaged, or an attempt to exhaust the memory."""

Buffer: TypeAlias = bytes | mmap.mmap
"""Bytes that hold records: a decompressed chunk or the mapped file."""

ChunkPosition: TypeAlias = tuple[int | None, int, int]
"""Offset of the compressed chunk (None for the file itself), first byte of the message, and its last byte + 1."""


class Channel(NamedTuple):
    """Messages of one type on one topic."""

    topic: str
    type: str
    """Full name, such as sensor_msgs/msg/PointCloud2, in ROS 2 and in ROS 1."""
    encoding: str
    """"cdr" (ROS 2), "ros1", or the name of an encoding that cannot be decoded."""


class Message(NamedTuple):
    """A message found by `BagFile.scan`."""

    channel: Channel
    time: int
    """Time of recording [ns]."""
    position: Any
    """Argument of `BagFile.read`. Its type depends on the file format."""
    size: int
    """Length of the whole message [bytes]."""
    head: bytes
    """First `HEAD_BYTES` bytes of the message; empty unless `BagFile.scan` was asked for its type."""


class BagFile(ABC):
    """One file of a recording. Opening it reads only its first bytes; `scan` is the one pass over the whole file."""

    def __init__(self, path: Path):
        self.path = path
        self.problems: list[str] = []
        """Defects found by `scan`. Each completes the sentence "FILE is ..."."""
        self.truncated = False
        """True if `scan` found that the end of the file is missing."""
        self.channels: dict[int, Channel] = {}
        """Channels found so far, by their number in the file."""
        self.damaged = 0
        """Number of records and chunks that could not be read."""

    @abstractmethod
    def scan(self, types: Collection[str]) -> Iterator[Message]:
        """Yield all messages in file order, with the heads of those of `types`. Stops where a truncated file ends."""

    @abstractmethod
    def read(self, position: Any) -> bytes:
        """Return the whole message at a position found by `scan`. Raises ValueError if it is damaged."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


def make_channel(topic: str, type_name: str, encoding: str) -> Channel:
    """Return a channel with its full type name. Raises ValueError for names that are not printable."""
    if not (topic + type_name + encoding).isprintable():
        raise ValueError("a channel's name is damaged")
    return Channel(topic, _full_type_name(type_name), encoding)


def _full_type_name(name: str) -> str:
    """Return pkg/msg/Type for pkg/Type, as ROS 2 spells it."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


def unwrap(data: bytes) -> bytes:
    """Return a message as it was published. With rosbag2's message compression each message is a zstd frame.

    A CDR message starts with a zero byte, so it cannot be mistaken for a zstd frame.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    return decompress("zstd", data, _MAX_DECOMPRESSED - 1, exact=False)


def decompress(compression: str, data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Decompress `data` to at most `size` bytes.

    Raises ValueError if the compression is unknown, the size absurd, or, unless `exact` is False, the result is not
    `size` bytes long.
    """
    if size >= _MAX_DECOMPRESSED:
        raise ValueError(f"a chunk claims a size of {size} bytes")
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
        raise ValueError(f"a chunk decompresses to {len(raw)} bytes instead of {size}")
    return raw


class ChunkedFile(BagFile):
    """A file of records, some of which are compressed chunks of records (MCAP and ROS 1).

    The file is mapped into memory, not loaded. A scan touches only the headers of records and the heads of messages,
    except that a compressed chunk has to be decompressed as a whole.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        with path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        # Neighbouring sweeps share a chunk. Two cover playback across the border between chunks.
        self._chunk = lru_cache(maxsize=2)(self._decompress_chunk)

    def read(self, position: ChunkPosition) -> bytes:
        """Return the message at a position found by `scan`. Raises ValueError if its chunk is damaged."""
        chunk, start, stop = position
        return unwrap(self._map[start:stop] if chunk is None else self._chunk(chunk)[start:stop])

    @abstractmethod
    def _decompress_chunk(self, offset: int) -> bytes:
        """Return the decompressed chunk at byte `offset`. Raises ValueError if it is damaged."""

    def message(
        self, channel: Channel, time: int, position: ChunkPosition, buffer: Buffer, types: Collection[str]
    ) -> Message:
        """Return the message at a position of `buffer`, with its head if it is one of `types`."""
        _, start, stop = position
        if channel.type not in types:
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
        self._chunk.cache_clear()
        self._map.close()
