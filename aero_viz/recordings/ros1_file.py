"""ROS 1 bags (format 2.0), read record by record: a bag without an index reads like any other."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import NamedTuple

from aero_viz.recordings.bagfile import BlockFile, Message, checked_channel, expand

__all__ = ["ROS1_MAGIC", "Ros1File"]

ROS1_MAGIC = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG_HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7
_U32 = struct.Struct("<I")


class _Record(NamedTuple):
    op: int
    header: dict[bytes, bytes]
    begin: int
    body: int
    end: int
    whole: bool


class Ros1File(BlockFile):
    """One ROS 1 bag (wiki.ros.org/Bags/Format/2.0). It needs no index; chunks may be plain, bz2 or lz4."""

    def scan(self, wanted: Collection[str]) -> Iterator[Message]:
        """Yield every message in the order of the file."""
        size, whole = len(self._map), True
        for record in _records(self._map, len(ROS1_MAGIC), size):
            whole &= record.whole
            if record.op == _BAG_HEADER:
                index = int.from_bytes(record.header.get(b"index_pos", b"\1"), "little")
                whole &= index <= size
                # The connections are repeated at the end: a damaged chunk must not hide them.
                for connection in _records(self._map, index, size) if 0 < index < size else ():
                    if connection.op == _CONNECTION and connection.whole:
                        self._connection(self._map, connection)
                if index == 0:
                    self.problems.append("unindexed: the recording was interrupted; `rosbag reindex` repairs it")
            elif record.op == _CHUNK:
                yield from self._chunk(record, wanted)
            elif record.op == _CONNECTION and record.whole:
                self._connection(self._map, record)
        if not whole:
            self.truncated = True

    def _chunk(self, chunk: _Record, wanted: Collection[str]) -> Iterator[Message]:
        compression = chunk.header.get(b"compression", b"").decode(errors="replace")
        plain = compression == "none"
        if not plain and not chunk.whole:
            return
        try:
            buffer = self._map if plain else self.block(chunk.begin)
        except Exception:
            self.damaged += 1
            return
        block = None if plain else chunk.begin
        for record in _records(buffer, *((chunk.body, chunk.end) if plain else (0, len(buffer)))):
            if not record.whole:
                break
            try:
                if record.op == _CONNECTION:
                    self._connection(buffer, record)
                elif record.op == _MESSAGE:
                    channel = self.channels[_U32.unpack(record.header[b"conn"])[0]]
                    seconds, nanoseconds = struct.unpack("<II", record.header[b"time"])
                    position = (block, record.body, record.end)
                    time = seconds * 10**9 + nanoseconds
                    yield self.message(channel, time, position, buffer, wanted)
            except (KeyError, struct.error):
                self.damaged += 1

    def _connection(self, buffer, record: _Record) -> None:
        try:
            number = _U32.unpack(record.header[b"conn"])[0]
            topic = record.header[b"topic"].decode()
            kind = _fields(buffer[record.body : record.end])[b"type"].decode()
            self.channels[number] = checked_channel(topic, kind, "ros1")
        except (KeyError, struct.error, ValueError):
            self.damaged += 1

    def expand_block(self, offset: int) -> bytes:
        """Decompress the chunk whose record starts at byte `offset`."""
        chunk = next(_records(self._map, offset, len(self._map)))
        compression = chunk.header[b"compression"].decode()
        return expand(compression, self._map[chunk.body : chunk.end], _U32.unpack(chunk.header[b"size"])[0])


def _records(buffer, start: int, stop: int) -> Iterator[_Record]:
    """Yield the records; the last one is not whole where the file ends within it or its header is damaged."""
    while start < stop:
        begin = start
        try:
            (length,) = _U32.unpack_from(buffer, start)
            body = start + 4 + length + 4
            if body > stop:
                raise ValueError
            header = _fields(buffer[start + 4 : body - 4])
            (size,) = _U32.unpack_from(buffer, body - 4)
            op = header[b"op"][0]
        except (KeyError, IndexError, ValueError, struct.error):
            yield _Record(-1, {}, begin, stop, stop, False)
            return
        start = body + size
        yield _Record(op, header, begin, body, min(start, stop), start <= stop)


def _fields(raw: bytes) -> dict[bytes, bytes]:
    """Return the name=value fields of a record's header."""
    fields, position = {}, 0
    while position < len(raw):
        (length,) = _U32.unpack_from(raw, position)
        name, _, value = raw[position + 4 : position + 4 + length].partition(b"=")
        fields[name] = value
        position += 4 + length
    return fields
