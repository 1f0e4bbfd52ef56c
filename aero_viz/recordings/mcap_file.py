"""MCAP files, read record by record: files whose end is missing read like whole ones."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema

from aero_viz.recordings.bagfile import BlockFile, Message, checked_channel, expand

__all__ = ["MCAP_MAGIC", "McapFile"]

MCAP_MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
_FOOTER = _RECORD.size + 20 + len(MCAP_MAGIC)
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")


class McapFile(BlockFile):
    """One MCAP file (mcap.dev/spec). The summary at its end helps past damage and is not needed."""

    def __init__(self, path: Path):
        super().__init__(path)
        self._schemas: dict[int, str] = {}

    def scan(self, wanted: Collection[str]) -> Iterator[Message]:
        """Yield every message in the order of the file; past a damaged record, from the next chunk of the index on."""
        chunks, start, finished, damaged = self._read_summary(), len(MCAP_MAGIC), False, False
        while not finished:
            for opcode, body, end, whole in _records(self._map, start, len(self._map)):
                if opcode == Opcode.DATA_END and whole:
                    finished = True
                    break
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(body, end, whole, wanted)
                elif whole:
                    yield from self._record(self._map, opcode, body, end, None, wanted)
                start = end if whole else start
            later = [chunk for chunk in chunks if chunk > start]
            if finished or not later:
                break
            start, damaged = min(later), True
        if damaged:
            self.problems.append("damaged: a record's length is wrong and what follows it up to the next chunk is lost")
        elif not finished:
            self.truncated = True

    def _read_summary(self) -> list[int]:
        """Learn the channels from the summary, where there is one, and return where the chunks start.

        Channels are declared in the first chunk, too, which may be the damaged one.
        """
        footer = len(self._map) - _FOOTER
        if self._map[-len(MCAP_MAGIC) :] != MCAP_MAGIC or footer < 0:
            return []
        (start,) = struct.unpack_from("<Q", self._map, footer + _RECORD.size)
        chunks = []
        if start:
            for opcode, body, end, whole in _records(self._map, start, footer):
                if opcode == Opcode.CHUNK_INDEX and whole and end - body >= 24:
                    chunks.append(struct.unpack_from("<QQQ", self._map, body)[2])
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and whole:
                    for _ in self._record(self._map, opcode, body, end, None, ()):
                        pass
        return chunks

    def _chunk(self, body: int, end: int, whole: bool, wanted: Collection[str]) -> Iterator[Message]:
        try:
            compression, start, stored, _ = self._chunk_header(body)
            # The last, incomplete chunk of a truncated file still holds whole messages when it is not compressed.
            if compression and not whole:
                return
            buffer = self.block(body) if compression else self._map
        except Exception:
            self.damaged += 1
            return
        block = body if compression else None
        first, last = (0, len(buffer)) if compression else (start, min(start + stored, end))
        for opcode, record, stop, complete in _records(buffer, first, last):
            if complete:
                yield from self._record(buffer, opcode, record, stop, block, wanted)

    def _record(self, buffer, opcode: int, body: int, end: int, block: int | None,
                wanted: Collection[str]) -> Iterator[Message]:  # fmt: skip
        try:
            if opcode == Opcode.MESSAGE:
                number, _, time, _ = _MESSAGE.unpack_from(buffer, body)
                channel, position = self.channels[number], (block, body + _MESSAGE.size, end)
                yield self.message(channel, time, position, buffer, wanted)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(buffer, body, end))
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                record = ChannelRecord.read(_stream(buffer, body, end))
                kind = self._schemas.get(record.schema_id, "")
                self.channels[record.id] = checked_channel(record.topic, kind, record.message_encoding)
        except (KeyError, struct.error, UnicodeDecodeError, ValueError):
            self.damaged += 1
        except Exception as error:  # mcap's own errors share no base class with a record that is too short
            if not type(error).__module__.startswith("mcap"):
                raise
            self.damaged += 1

    def _chunk_header(self, body: int) -> tuple[str, int, int, tuple[int, int]]:
        """Return compression, first data byte, compressed length, (expanded length, checksum)."""
        _, _, size, checksum, length = _CHUNK.unpack_from(self._map, body)
        name = body + _CHUNK.size
        compression = self._map[name : name + length].decode()
        (stored,) = struct.unpack_from("<Q", self._map, name + length)
        return compression, name + length + 8, stored, (size, checksum)

    def expand_block(self, offset: int) -> bytes:
        """Decompress the chunk whose content starts at byte `offset`; raises ValueError on a wrong checksum."""
        compression, start, stored, (size, checksum) = self._chunk_header(offset)
        raw = expand(compression, self._map[start : start + stored], size)
        if checksum and zlib.crc32(raw) != checksum:
            raise ValueError("a chunk's checksum is wrong")
        return raw


def _records(buffer, start: int, stop: int) -> Iterator[tuple[int, int, int, bool]]:
    """Yield (opcode, first byte, last byte + 1, whole) of each record; an incomplete last one ends at `stop`."""
    while start + _RECORD.size <= stop:
        opcode, size = _RECORD.unpack_from(buffer, start)
        body = start + _RECORD.size
        start = body + size
        yield opcode, body, min(start, stop), start <= stop


def _stream(buffer, body: int, end: int) -> ReadDataStream:
    return ReadDataStream(BytesIO(buffer[body:end]))
