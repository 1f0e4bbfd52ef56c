"""Messages between the node and its viewers: a header, and zlib over a JSON description and arrays.

Little-endian. Header: magic "AERO", version (2 bytes), kind (2), length of the compressed content (4), length of the
content (4), CRC-32 of the compressed content (4). Content: length of the JSON text (4), the text, then the bytes of the
arrays in the order in which the text lists them. Every length is bounded, so that garbage costs no memory.
"""

from __future__ import annotations

import enum
import json
import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["VERSION", "Kind", "Message", "MessageReader", "encode"]

VERSION = 1
"""Raised whenever a reader of the version before would go wrong."""

_MAGIC = b"AERO"
_HEADER = struct.Struct("<4sHHIII")
_LENGTH = struct.Struct("<I")
_LARGEST = 32 << 20
"""Of the content [bytes]."""
_TYPES = {"<f2", "<f4", "<f8", "<i2", "<i4", "|u1"}
_LEVEL = 1
"""Of zlib: the link is faster than a better compression."""


class Kind(enum.IntEnum):
    """What a message is."""

    HELLO = 1
    """The first: versions and configuration."""
    PLAN = 2
    """A plan and what it was made from."""
    CHANGE = 3
    """A transition of the safety state."""


@dataclass(frozen=True, eq=False)
class Message:
    """A message taken apart."""

    kind: int
    values: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


def encode(kind: Kind, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> bytes:
    """Return a message.

    Args:
        kind: of the message.
        values: what JSON can hold.
        arrays: float16, 32 or 64, int16 or 32, or uint8.

    Raises:
        ValueError: an array has another type, or all is larger than a reader takes.
    """
    described, parts = [], []
    for name, array in (arrays or {}).items():
        content: Any = np.asarray(array)
        content = content.astype(content.dtype.newbyteorder("<"), copy=False)
        if content.dtype.str not in _TYPES:
            raise ValueError(f"{name} has type {content.dtype}; a message can't hold it.")
        described.append([name, content.dtype.str, list(content.shape)])
        parts.append(content.tobytes())
    text = json.dumps({"values": dict(values), "arrays": described}).encode()
    content = b"".join((_LENGTH.pack(len(text)), text, *parts))
    if len(content) > _LARGEST:
        raise ValueError(f"a message of {len(content)} bytes is larger than {_LARGEST}; send fewer points.")
    packed = zlib.compress(content, _LEVEL)
    return _HEADER.pack(_MAGIC, VERSION, kind, len(packed), len(content), zlib.crc32(packed)) + packed


class MessageReader:
    """Finds messages in a stream of bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """Take in bytes and return the messages that are complete.

        Raises:
            ValueError: the bytes are no messages of this version; the stream can't be used any further.
        """
        self._buffer += data
        messages = []
        while len(self._buffer) >= _HEADER.size:
            magic, version, kind, length, size, checksum = _HEADER.unpack_from(self._buffer)
            if magic != _MAGIC:
                raise ValueError("what answers there is no aero-planner node.")
            if version != VERSION:
                raise ValueError(
                    f"the node speaks version {version} of the telemetry protocol and this program version {VERSION}; "
                    "install the same release on both."
                )
            if not 0 < length <= _LARGEST or not _LENGTH.size <= size <= _LARGEST:
                raise ValueError("a telemetry message has an impossible length.")
            end = _HEADER.size + length
            if len(self._buffer) < end:
                break
            packed = bytes(self._buffer[_HEADER.size : end])
            del self._buffer[:end]
            if zlib.crc32(packed) != checksum:
                raise ValueError("a telemetry message is damaged: its checksum is wrong.")
            messages.append(_unpack(kind, packed, size))
        return messages


def _unpack(kind: int, packed: bytes, size: int) -> Message:
    try:
        # Never more than was announced, whatever the stream would grow to.
        content = zlib.decompressobj().decompress(packed, size)
        if len(content) != size:
            raise ValueError("its content ends early")
        (length,) = _LENGTH.unpack_from(content)
        described = json.loads(content[_LENGTH.size : _LENGTH.size + length])
        values, arrays, start = dict(described["values"]), {}, _LENGTH.size + length
        for name, kind_of, shape in described["arrays"]:
            if kind_of not in _TYPES or not all(isinstance(n, int) and n >= 0 for n in shape):
                raise ValueError(f"array {name!r} is of no known type")
            count = math.prod(shape)
            arrays[str(name)] = np.frombuffer(content, kind_of, count, start).reshape(shape)
            start += count * np.dtype(kind_of).itemsize
    except (zlib.error, struct.error, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"a telemetry message is damaged: {error}.") from error
    return Message(kind, values, arrays)
