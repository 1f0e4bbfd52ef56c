"""MCAP files, read record by record so that a file without its end reads like a whole one."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema

from aero_viz.recordings.bag_file import Buffer, ChunkedFile, Message, decompress, make_channel

__all__ = ["MCAP_MAGIC", "McapFile"]

MCAP_MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
_FOOTER = _RECORD.size + 20 + len(MCAP_MAGIC)
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")


class _Record(NamedTuple):
    """Location of a record's content in its buffer."""

    opcode: int
    start: int
    stop: int
    """Last byte + 1; the end of the buffer where the record is incomplete."""
    complete: bool


class _ChunkHeader(NamedTuple):
    """The fields of a chunk before its records."""

    compression: str
    """"zstd", "lz4" or empty."""
    start: int
    """First byte of the records in the file."""
    stored_size: int
    """Length of the records in the file [bytes]."""
    size: int
    """Length of the decompressed records [bytes]."""
    checksum: int
    """CRC-32 of the decompressed records, 0 if unset."""


class McapFile(ChunkedFile):
    """One MCAP file (mcap.dev/spec).

    The mcap package's readers give up on a truncated file; this one needs no summary and uses it only to continue
    behind damage. mcap decodes the small records.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._schemas: dict[int, str] = {}

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        """Yield all messages in file order. Behind a damaged record, continue at the next chunk of the index."""
        chunks, start, finished, damaged = self._read_summary(), len(MCAP_MAGIC), False, False
        while not finished:
            for record in _records(self._map, start, len(self._map)):
                if record.opcode == Opcode.DATA_END and record.complete:
                    finished = True
                    break
                if record.opcode == Opcode.CHUNK:
                    yield from self._read_chunk(record, types)
                elif record.complete:
                    yield from self._read_record(self._map, record, None, types)
                start = record.stop if record.complete else start
            later = [chunk for chunk in chunks if chunk > start]
            if finished or not later:
                break
            start, damaged = min(later), True
        if damaged:
            self.problems.append(
                "damaged: the length of a record is wrong, and everything from it to the next chunk is lost"
            )
        elif not finished:
            self.truncated = True

    def _read_summary(self) -> list[int]:
        """Read the channels from the summary, if there is one, and return the offsets of the chunks.

        The first chunk declares the channels, too, but it may be damaged.
        """
        footer = len(self._map) - _FOOTER
        if self._map[-len(MCAP_MAGIC) :] != MCAP_MAGIC or footer < 0:
            return []
        (start,) = struct.unpack_from("<Q", self._map, footer + _RECORD.size)
        chunks = []
        if start:
            for record in _records(self._map, start, footer):
                if record.opcode == Opcode.CHUNK_INDEX and record.complete and record.stop - record.start >= 24:
                    chunks.append(struct.unpack_from("<QQQ", self._map, record.start)[2])
                elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and record.complete:
                    for _ in self._read_record(self._map, record, None, ()):
                        pass
        return chunks

    def _read_chunk(self, record: _Record, types: Collection[str]) -> Iterator[Message]:
        try:
            header = self._chunk_header(record.start)
            # The incomplete last chunk of a truncated file still has whole messages if it is not compressed.
            if header.compression and not record.complete:
                return
            buffer = self._chunk(record.start) if header.compression else self._map
        except Exception:
            self.damaged += 1
            return
        if header.compression:
            offset, start, stop = record.start, 0, len(buffer)
        else:
            offset, start, stop = None, header.start, min(header.start + header.stored_size, record.stop)
        for inner in _records(buffer, start, stop):
            if inner.complete:
                yield from self._read_record(buffer, inner, offset, types)

    def _read_record(
        self, buffer: Buffer, record: _Record, chunk: int | None, types: Collection[str]
    ) -> Iterator[Message]:
        try:
            if record.opcode == Opcode.MESSAGE:
                number, _, time, _ = _MESSAGE.unpack_from(buffer, record.start)
                position = (chunk, record.start + _MESSAGE.size, record.stop)
                yield self.message(self.channels[number], time, position, buffer, types)
            elif record.opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(buffer, record))
                self._schemas[schema.id] = schema.name
            elif record.opcode == Opcode.CHANNEL:
                channel = ChannelRecord.read(_stream(buffer, record))
                type_name = self._schemas.get(channel.schema_id, "")
                self.channels[channel.id] = make_channel(channel.topic, type_name, channel.message_encoding)
        except (KeyError, struct.error, UnicodeDecodeError, ValueError):
            self.damaged += 1
        except Exception as error:  # mcap raises several unrelated classes for a record that is too short
            if not type(error).__module__.startswith("mcap"):
                raise
            self.damaged += 1

    def _chunk_header(self, offset: int) -> _ChunkHeader:
        _, _, size, checksum, length = _CHUNK.unpack_from(self._map, offset)
        name = offset + _CHUNK.size
        compression = self._map[name : name + length].decode()
        (stored_size,) = struct.unpack_from("<Q", self._map, name + length)
        return _ChunkHeader(compression, name + length + 8, stored_size, size, checksum)

    def _decompress_chunk(self, offset: int) -> bytes:
        header = self._chunk_header(offset)
        raw = decompress(header.compression, self._map[header.start : header.start + header.stored_size], header.size)
        if header.checksum and zlib.crc32(raw) != header.checksum:
            raise ValueError("the checksum of a chunk is wrong")
        return raw


def _records(buffer: Buffer, start: int, stop: int) -> Iterator[_Record]:
    """Yield the records between two bytes of a buffer. The last one may be incomplete."""
    while start + _RECORD.size <= stop:
        opcode, size = _RECORD.unpack_from(buffer, start)
        content = start + _RECORD.size
        start = content + size
        yield _Record(opcode, content, min(start, stop), start <= stop)


def _stream(buffer: Buffer, record: _Record) -> ReadDataStream:
    return ReadDataStream(BytesIO(buffer[record.start : record.stop]))
