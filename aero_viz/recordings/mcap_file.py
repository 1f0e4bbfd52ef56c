"""MCAP files, read record by record so that a file without its end reads like a whole one."""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema

from aero_viz.input_limits import BLOCK_MAX, CHECKSUM_MAX
from aero_viz.recordings.bag_file import HEAD_BYTES, Buffer, ChunkedFile, Message, decompress, make_channel

MCAP_MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
_FOOTER = _RECORD.size + 20 + len(MCAP_MAGIC)
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_DECLARATION_MAX = 1 << 24
"""A schema or channel record that is longer [bytes] is damaged."""
_PIECE = 1 << 20
"""Bytes of the file whose checksum is computed at once."""


class _Record(NamedTuple):
    """Location of a record's content in its buffer."""

    opcode: int
    start: int
    stop: int
    """Last byte + 1; the end of the buffer where the record is incomplete."""
    complete: bool


class _Summary(NamedTuple):
    """The part of the summary that a scan uses."""

    chunks: list[int]
    """Offsets of the chunks, ascending."""
    messages: int | None
    """Number of messages in the file, None if it is not recorded."""


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
    behind damage and to count what is missing. mcap decodes the small records.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._schemas: dict[int, str] = {}
        self._unverified = CHECKSUM_MAX
        self._found = 0
        self._has_bare_messages = False

    def _scan(self, types: Collection[str]) -> Iterator[Message]:
        """Yield all messages in file order. Behind a damaged record, continue at the next chunk of the index."""
        self._unverified, self._found, self._has_bare_messages = CHECKSUM_MAX, 0, False
        summary, start, finished, damaged = self._read_summary(), len(MCAP_MAGIC), False, False
        while not finished:
            for record in self.limited(_records(self._bytes, start, len(self._bytes))):
                if record.opcode == Opcode.DATA_END and record.complete:
                    self._check_data_section(record)
                    finished = True
                    break
                if record.opcode == Opcode.CHUNK:
                    yield from self._read_chunk(record, types)
                elif record.complete:
                    self._has_bare_messages |= record.opcode == Opcode.MESSAGE
                    yield from self._read_record(self._bytes, record, (None, 0), types)
                start = record.stop if record.complete else start
            following = bisect_right(summary.chunks, start)
            if finished or following == len(summary.chunks):
                break
            start, damaged = summary.chunks[following], True
        if damaged:
            self.problems.append(
                "damaged: the length of a record is wrong, and everything from it to the next chunk is lost"
            )
        elif not finished:
            self.truncated = True
        if summary.messages is not None and self._found < summary.messages:
            lost = summary.messages - self._found
            self.problems.append(f"incomplete: {lost} of the {summary.messages} messages that it counts are missing")

    def _read_summary(self) -> _Summary:
        """Read the summary, if there is one, and the channels in it.

        The first chunk declares the channels, too, but it may be damaged.
        """
        data, footer = self._bytes, len(self._bytes) - _FOOTER
        if footer < 0 or data[len(data) - len(MCAP_MAGIC) : len(data)] != MCAP_MAGIC:
            return _Summary([], None)
        start, _, checksum = struct.unpack("<QQI", data[footer + _RECORD.size : footer + _FOOTER - len(MCAP_MAGIC)])
        # The checksum covers the summary and the footer up to itself.
        if not start or (checksum and self._checksum(start, footer + _RECORD.size + 16) != checksum):
            return _Summary([], None)
        chunks, messages = [], None
        for record in self.limited(_records(data, start, footer)):
            if not record.complete:
                continue
            if record.opcode == Opcode.CHUNK_INDEX and record.stop - record.start >= 24:
                chunks.append(struct.unpack("<QQQ", data[record.start : record.start + 24])[2])
            elif record.opcode == Opcode.STATISTICS and record.stop - record.start >= 8:
                messages = int.from_bytes(data[record.start : record.start + 8], "little")
            elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                for _ in self._read_record(data, record, (None, 0), ()):
                    pass
        return _Summary(sorted(chunks), messages)

    def _check_data_section(self, end: _Record) -> None:
        """Report a wrong checksum of all records before `end`, if messages rely on it. Chunks have their own."""
        content = self._bytes[end.start : end.stop]
        checksum = int.from_bytes(content[:4], "little")
        stop = end.start - _RECORD.size
        if checksum and self._has_bare_messages and stop <= CHECKSUM_MAX and self._checksum(0, stop) != checksum:
            self.problems.append("damaged: the checksum of its content is wrong, and any message may be")

    def _checksum(self, start: int, stop: int) -> int:
        checksum = 0
        for at in range(start, stop, _PIECE):
            checksum = zlib.crc32(self._bytes.fresh(at, min(at + _PIECE, stop)), checksum)
        return checksum

    def _read_chunk(self, record: _Record, types: Collection[str]) -> Iterator[Message]:
        try:
            header = self._chunk_header(record.start)
        except (struct.error, UnicodeDecodeError):
            self.damaged += 1
            return
        # The incomplete last chunk of a truncated file still has whole messages if it is not compressed.
        if header.compression and not record.complete:
            return
        # A chunk with a checksum is read through it, now and whenever one of its messages is played.
        whole = record.complete and header.stored_size <= BLOCK_MAX and bool(header.compression or header.checksum)
        buffer, start, stop = self._bytes, header.start, min(header.start + header.stored_size, record.stop)
        base = (record.start, header.start) if whole else (None, 0)
        if whole and (header.compression or self._unverified > 0):
            if header.compression:
                self._budget.take_bytes(header.size)
            else:
                self._unverified -= header.stored_size
            try:
                buffer = self._chunk(record.start)
            except Exception:
                self.damaged += 1
                return
            start, stop, base = 0, len(buffer), (record.start, 0)
        inner = None
        for inner in self.limited(_records(buffer, start, stop)):
            if inner.complete:
                yield from self._read_record(buffer, inner, base, types)
        if record.complete and inner is not None and not inner.complete:
            self.damaged += 1

    def _read_record(
        self, buffer: Buffer, record: _Record, base: tuple[int | None, int], types: Collection[str]
    ) -> Iterator[Message]:
        """Yield the message of a record, or keep the schema or channel in it.

        Args:
            buffer: holds the record.
            record: a whole record.
            base: chunk of the messages' positions, None for the file, and the byte of `buffer` they count from.
            types: see `scan`.
        """
        try:
            if record.opcode == Opcode.MESSAGE:
                content = buffer[record.start : min(record.stop, record.start + _MESSAGE.size + HEAD_BYTES)]
                number, _, time, _ = _MESSAGE.unpack(content[: _MESSAGE.size])
                position = (base[0], record.start + _MESSAGE.size - base[1], record.stop - base[1])
                message = self.message(self.channels[number], time, position, content[_MESSAGE.size :], types)
                self._found += 1
                yield message
            elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._read_declaration(
                    record.opcode, buffer[record.start : min(record.stop, record.start + _DECLARATION_MAX)]
                )
        except (KeyError, struct.error, UnicodeDecodeError, ValueError):
            self.damaged += 1
        except Exception as error:  # mcap raises several unrelated classes for a record that is too short
            if not type(error).__module__.startswith("mcap"):
                raise
            self.damaged += 1

    def _read_declaration(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema.name
            if schema.encoding == "ros2msg":
                self.definitions[schema.name] = schema.data.decode()
        else:
            channel = ChannelRecord.read(stream)
            type_name = self._schemas.get(channel.schema_id, "")
            self.channels[channel.id] = make_channel(channel.topic, type_name, channel.message_encoding)

    def _chunk_header(self, offset: int) -> _ChunkHeader:
        _, _, size, checksum, length = _CHUNK.unpack(self._bytes[offset : offset + _CHUNK.size])
        name = offset + _CHUNK.size
        compression = self._bytes[name : name + min(length, 64)].decode()
        stored_size = int.from_bytes(self._bytes[name + length : name + length + 8], "little")
        return _ChunkHeader(compression, name + length + 8, stored_size, size, checksum)

    def _decompress_chunk(self, offset: int) -> bytes:
        header = self._chunk_header(offset)
        raw = self._bytes.fresh(header.start, header.start + min(header.stored_size, BLOCK_MAX))
        if header.compression:
            raw = decompress(header.compression, raw, header.size)
        if header.checksum and zlib.crc32(raw) != header.checksum:
            raise ValueError("the checksum of a chunk is wrong")
        return raw


def _records(buffer: Buffer, start: int, stop: int) -> Iterator[_Record]:
    """Yield the records between two bytes of a buffer. The last one may be incomplete."""
    while start + _RECORD.size <= stop:
        header = buffer[start : start + _RECORD.size]
        if len(header) < _RECORD.size:  # the file has shrunk
            return
        opcode, size = _RECORD.unpack(header)
        content = start + _RECORD.size
        start = content + size
        yield _Record(opcode, content, min(start, stop), start <= stop)
