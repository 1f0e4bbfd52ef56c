"""ROS 1 bags (format 2.0), read record by record so that a bag without an index reads like a whole one."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import NamedTuple

from aero_viz.input_limits import BLOCK_MAX, LimitExceeded
from aero_viz.recordings.bag_file import HEAD_BYTES, Buffer, ChunkedFile, Message, decompress, make_channel

ROS1_MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG_HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_U32 = struct.Struct("<I")
_HEADER_MAX = 1 << 20
"""A record's header that is longer [bytes] is damaged; so is a description of a connection of 16 times this."""


class _Record(NamedTuple):
    """A record and the location of its content in its buffer."""

    op: int
    """Kind of record; -1 where its header cannot be read."""
    header: dict[bytes, bytes]
    offset: int
    """First byte of the record."""
    start: int
    """First byte of its content."""
    stop: int
    """Last byte of its content + 1; the end of the buffer where the record is incomplete."""
    complete: bool


class Ros1File(ChunkedFile):
    """One ROS 1 bag (wiki.ros.org/Bags/Format/2.0). It needs no index. Chunks may be plain, bz2 or lz4."""

    _found = 0

    def _scan(self, types: Collection[str]) -> Iterator[Message]:
        size, complete, index = len(self._bytes), True, None
        self._found, declared = 0, 0
        for record in self.limited(_records(self._bytes, len(ROS1_MAGIC), size)):
            complete &= record.complete
            if record.op == _BAG_HEADER and index is None:
                index = int.from_bytes(record.header.get(b"index_pos", b"\1"), "little")
                complete &= index <= size
                declared = self._read_index(index) if 0 < index < size else 0
                if index == 0:
                    self.problems.append(
                        "unindexed, because the recording was interrupted; `rosbag reindex` repairs it"
                    )
            elif record.op == _CHUNK:
                yield from self._read_chunk(record, types)
            elif record.op == _CONNECTION and record.complete:
                self._read_connection(self._bytes, record)
            elif record.op == _MESSAGE and record.complete:  # of the last chunk, if recording was interrupted
                yield from self._read_message(self._bytes, record, None, types)
        self.truncated = not complete
        if self._found < declared:
            lost = declared - self._found
            self.problems.append(f"incomplete: {lost} of the {declared} messages that its index counts are missing")

    def _read_index(self, start: int) -> int:
        """Read the connections, which a damaged chunk would hide, and return the number of messages in the file."""
        messages = 0
        for record in self.limited(_records(self._bytes, start, len(self._bytes))):
            if record.op == _CONNECTION and record.complete:
                self._read_connection(self._bytes, record)
            elif record.op == _CHUNK_INFO and record.complete:
                content = self._bytes[record.start : min(record.stop, record.start + _HEADER_MAX)]
                messages += sum(count for _, count in struct.iter_unpack("<II", content[: len(content) // 8 * 8]))
        return messages

    def _read_chunk(self, chunk: _Record, types: Collection[str]) -> Iterator[Message]:
        plain = chunk.header.get(b"compression", b"") == b"none"
        if not plain and not chunk.complete:
            return
        try:
            if not plain:
                self._budget.take_bytes(_U32.unpack(chunk.header[b"size"])[0])
            buffer = self._bytes if plain else self._chunk(chunk.offset)
        except LimitExceeded:
            raise
        except Exception:
            self.damaged += 1
            return
        if plain:
            offset, start, stop = None, chunk.start, chunk.stop
        else:
            offset, start, stop = chunk.offset, 0, len(buffer)
        for record in self.limited(_records(buffer, start, stop)):
            if not record.complete:
                self.damaged += chunk.complete
                break
            if record.op == _CONNECTION:
                self._read_connection(buffer, record)
            elif record.op == _MESSAGE:
                yield from self._read_message(buffer, record, offset, types)

    def _read_message(
        self, buffer: Buffer, record: _Record, chunk: int | None, types: Collection[str]
    ) -> Iterator[Message]:
        """Yield the message of a record, nothing if it is damaged.

        Args:
            buffer: holds the record.
            record: the record.
            chunk: first byte of its compressed chunk, None if it is not in one.
            types: see `scan`.
        """
        try:
            channel = self.channels[_U32.unpack(record.header[b"conn"])[0]]
            seconds, nanoseconds = struct.unpack("<II", record.header[b"time"])
        except (KeyError, struct.error):
            self.damaged += 1
            return
        head = buffer[record.start : min(record.stop, record.start + HEAD_BYTES)]
        position = (chunk, record.start, record.stop)
        self._found += 1
        yield self.message(channel, seconds * 10**9 + nanoseconds, position, head, types)

    def _read_connection(self, buffer: Buffer, record: _Record) -> None:
        try:
            number = _U32.unpack(record.header[b"conn"])[0]
            topic = record.header[b"topic"].decode()
            description = buffer[record.start : min(record.stop, record.start + 16 * _HEADER_MAX)]
            type_name = _fields(description)[b"type"].decode()
            self.channels[number] = make_channel(topic, type_name, "ros1")
        except (KeyError, struct.error, ValueError):
            self.damaged += 1

    def _decompress_chunk(self, offset: int) -> bytes:
        chunk = next(_records(self._bytes, offset, len(self._bytes)))
        compression, size = chunk.header[b"compression"].decode(), _U32.unpack(chunk.header[b"size"])[0]
        if chunk.stop - chunk.start > BLOCK_MAX:
            raise ValueError("a chunk is too large")
        return decompress(compression, self._bytes.fresh(chunk.start, chunk.stop), size)


def _records(buffer: Buffer, start: int, stop: int) -> Iterator[_Record]:
    """Yield the records between two bytes of a buffer. The last one is incomplete where it is cut or damaged."""
    while start < stop:
        offset = start
        try:
            (length,) = _U32.unpack(buffer[offset : offset + 4])
            content = offset + 4 + length + 4
            if content > stop or length > _HEADER_MAX:
                raise ValueError
            raw = buffer[offset + 4 : content]
            header = _fields(raw[:-4])
            (size,) = _U32.unpack(raw[-4:])
            op = header[b"op"][0]
        except (KeyError, IndexError, ValueError, struct.error):
            yield _Record(-1, {}, offset, stop, stop, False)
            return
        start = content + size
        yield _Record(op, header, offset, content, min(start, stop), start <= stop)


def _fields(raw: bytes) -> dict[bytes, bytes]:
    """Return the name=value fields of a record's header."""
    fields, position = {}, 0
    while position < len(raw):
        (length,) = _U32.unpack_from(raw, position)
        name, _, value = raw[position + 4 : position + 4 + length].partition(b"=")
        fields[name] = value
        position += 4 + length
    return fields
