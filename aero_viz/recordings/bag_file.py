"""The base of all file readers, and the base of those whose files consist of chunks of records."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from aero_planner import plain_text
from aero_viz.input_limits import BLOCK_MAX, NAME_MAX, LimitExceeded, ReadingBudget
from aero_viz.recordings.file_bytes import FileBytes

HEAD_BYTES = 4096
"""Length of a message's head [bytes]: enough for the layout of a cloud and for a whole pose."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Start of a zstd frame, which holds a whole compressed file or one compressed message."""

_PIECE = 1 << 20
"""Bytes that are decompressed at once where the size of the result is not known."""

_Record = TypeVar("_Record")

Buffer: TypeAlias = bytes | FileBytes
"""Bytes that hold records: a chunk or the file."""

ChunkPosition: TypeAlias = tuple[int | None, int, int]
"""Offset of the compressed chunk (None for the file itself), first byte of the message, and its last byte + 1."""


class Mounting(NamedTuple):
    """Pose of a sensor in the body's frame."""

    position: NDArray[np.float64]
    """[3] [m]."""
    quaternion: NDArray[np.float64]
    """[4] w, x, y, z."""
    notice: str
    """Sentence for the user on where it is from."""


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
        """Path by which the user knows the file."""
        self.budget_share = 1.0
        """Share of the fixed allowances of a recording, see `ReadingBudget`, that this file may use."""
        self.problems: list[str] = []
        """Defects found by `scan`. Each completes the sentence "FILE is ..."."""
        self.truncated = False
        """True if `scan` found that the end of the file is missing."""
        self.channels: dict[int, Channel] = {}
        """Channels found so far, by their number in the file."""
        self.definitions: dict[str, str] = {}
        """Definitions of types of ROS 2 messages that the file holds, as far as they were found."""
        self.mounting: Mounting | None = None
        """Pose of the sensor in the body's frame, where the file has one."""
        self.is_of_chosen_sensor = False
        """True if only the messages of one sensor are read, which was chosen when the file was opened."""
        self.notices: list[str] = []
        """Assumptions about the file, one sentence each."""
        self.damaged = 0
        """Number of records and chunks that could not be read."""

    @property
    def parts(self) -> list[Path]:
        """The files that it is made of."""
        return [self.path]

    def number(self, position: Any) -> int | None:
        """Return the number in the name of the file that a message was made from; None where there is none."""
        return None

    @abstractmethod
    def scan(self, types: Collection[str]) -> Iterator[Message]:
        """Yield all messages in file order, with the heads of those of `types`. Stops where a truncated file ends."""

    @abstractmethod
    def read(self, position: Any) -> bytes:
        """Return the whole message at a position found by `scan`. Raises ValueError if it is damaged."""

    def prefetch(self, position: Any, limit: int) -> int:
        """Let the system read a message in the background, and return its length if that is at most `limit` [bytes].

        Returns 0 and does nothing where the file's format does not show where a message is.
        """
        return 0

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


def make_channel(topic: str, type_name: str, encoding: str) -> Channel:
    """Return a channel with its full type name. Raises ValueError for names that are long or not printable."""
    names = topic + type_name + encoding
    if len(names) > NAME_MAX or not names.isprintable():
        raise ValueError("a channel's name is damaged")
    return Channel(topic, _full_type_name(type_name), encoding)


def _full_type_name(name: str) -> str:
    """Return pkg/msg/Type for pkg/Type, as ROS 2 spells it."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


def one_line(error: Exception) -> str:
    """Return the text of a library's error as a single printable line, without a full stop at its end."""
    return plain_text.one_line(error).removesuffix(".") or type(error).__name__


def list_names(names: list[str]) -> str:
    """Return the first names, and the number of further ones."""
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")


def unwrap(data: bytes) -> bytes:
    """Return a message as it was published. With rosbag2's message compression each message is a zstd frame.

    A CDR message starts with a zero byte, so it cannot be mistaken for a zstd frame.

    Raises:
        ValueError: the frame is damaged or too large.
    """
    if not data.startswith(ZSTD_MAGIC):
        return data
    return _decompress_zstd(data, None)


def decompress(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk of `size` bytes.

    Raises:
        ValueError: the compression is unknown, the size absurd, or the result not `size` bytes long.
    """
    if size > BLOCK_MAX:
        raise ValueError(f"a chunk claims a size of {size} bytes")
    if compression == "zstd":
        raw = _decompress_zstd(data, size)
    elif compression == "lz4":
        import lz4.frame

        raw = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    elif compression == "bz2":
        import bz2

        raw = bz2.BZ2Decompressor().decompress(data, max_length=size)
    else:
        raise ValueError(f"unknown compression {compression!r}")
    if len(raw) != size:
        raise ValueError(f"a chunk decompresses to {len(raw)} bytes instead of {size}")
    return raw


def _decompress_zstd(data: bytes, size: int | None) -> bytes:
    """Decompress zstd frames to at most `size` bytes, or `BLOCK_MAX` if that is None."""
    import zstandard

    limit = BLOCK_MAX if size is None else size
    try:
        claimed = zstandard.get_frame_parameters(data).content_size
        if claimed == size or (size is None and claimed <= limit):
            return zstandard.ZstdDecompressor().decompress(data)  # allocates what the frame claims, at once
        reader = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
        parts: list[bytes] = []
        while limit > 0 and (part := reader.read(min(limit, _PIECE))):
            parts.append(part)
            limit -= len(part)
    except zstandard.ZstdError as error:
        raise ValueError(f"a zstd frame is damaged ({error})") from error
    if size is None and limit == 0:
        raise ValueError(f"a message decompresses to more than {BLOCK_MAX} bytes")
    return b"".join(parts)


class ChunkedFile(BagFile):
    """A file of records, some of which are compressed chunks of records (MCAP and ROS 1).

    A scan touches only the headers of records and the heads of messages, except that chunks with a compression or a
    checksum have to be read as a whole.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._bytes = FileBytes(path)
        self._budget = ReadingBudget(len(self._bytes))
        # Neighbouring sweeps share a chunk. Two cover playback across the border between chunks.
        self._chunk = lru_cache(maxsize=2)(self._decompress_chunk)

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        self._budget = ReadingBudget(len(self._bytes), self.budget_share)
        try:
            yield from self._scan(types)
        except LimitExceeded as error:
            self.problems.append(str(error))

    @abstractmethod
    def _scan(self, types: Collection[str]) -> Iterator[Message]:
        """Yield the messages of `scan`. Raises LimitExceeded where the budget ends."""

    def read(self, position: ChunkPosition) -> bytes:
        """Return the message at a position found by `scan`. Raises ValueError if its chunk is damaged."""
        chunk, start, stop = position
        data = self._bytes.fresh(start, stop) if chunk is None else self._chunk(chunk)[start:stop]
        if len(data) != stop - start:
            raise ValueError(f"{self.path} has shrunk since it was opened")
        return unwrap(data)

    def prefetch(self, position: ChunkPosition, limit: int) -> int:
        chunk, start, stop = position
        if chunk is not None:  # the length of the compressed chunk is not known, but it is hardly longer than this
            start, stop = chunk, chunk + stop - start
        if stop - start > limit:
            return 0
        self._bytes.prefetch(start, stop)
        return stop - start

    def limited(self, records: Iterator[_Record]) -> Iterator[_Record]:
        """Yield records, and raise LimitExceeded where the time for the scan is up."""
        for number, record in enumerate(records):
            if number % 128 == 0:
                self._budget.check_time()
            yield record

    @abstractmethod
    def _decompress_chunk(self, offset: int) -> bytes:
        """Return the decompressed chunk at byte `offset`. Raises ValueError if it is damaged."""

    def message(
        self, channel: Channel, time: int, position: ChunkPosition, head: bytes, types: Collection[str]
    ) -> Message:
        """Return the message at a position, with its head if it is one of `types`.

        Args:
            channel: its channel.
            time: its time of recording [ns].
            position: where it is.
            head: its first `HEAD_BYTES` bytes.
            types: see `scan`.
        """
        _, start, stop = position
        if channel.type not in types:
            return Message(channel, time, position, stop - start, b"")
        if not head.startswith(ZSTD_MAGIC):
            return Message(channel, time, position, stop - start, head)
        try:
            whole = self.read(position)
        except Exception:
            whole = b""
        self._budget.take_bytes(len(whole))
        return Message(channel, time, position, len(whole), whole[:HEAD_BYTES])

    def close(self) -> None:
        self._chunk.cache_clear()
        self._bytes.close()
