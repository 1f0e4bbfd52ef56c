"""Framing of the messages between the node and its viewers.

Little-endian. Header: magic "AERO", version (2 bytes), kind (2), length of the compressed content (4), length of the
content (4), CRC-32 of the compressed content (4). The content is compressed with zlib: length of a JSON text (4), the
text, then the bytes of the arrays in the order in which the text lists them. Every length is bounded, so that damaged
input cannot exhaust memory.
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

from aero_planner.user_file import parse_json

VERSION = 1
"""Increased whenever a reader of the previous version would misread a message."""

_MAGIC = b"AERO"
_HEADER = struct.Struct("<4sHHIII")
_LENGTH = struct.Struct("<I")
_MAX_LENGTH = 32 << 20
"""Largest length of the content [bytes]."""
_TYPES = {"<f2", "<f4", "<f8", "<i2", "<i4", "|u1"}
_LEVEL = 1
"""Compression level of zlib: a better compression would take longer than sending the difference."""


class Kind(enum.IntEnum):
    """Kind of a message."""

    HELLO = 1
    """The first message: configurations of planner and node."""
    PLAN = 2
    """A plan and its inputs."""
    CHANGE = 3
    """A transition of the safety state."""
    REQUEST = 4
    """Sealed, from a viewer: first with its nonce to prove that it holds the key, then a change of parameters."""
    STATUS = 5
    """The present parameters and the answer to a request; sealed for a viewer who holds the key."""
    EVENT = 6
    """The end of a leg of the mission."""


@dataclass(frozen=True, eq=False)
class Message:
    """A decoded message."""

    kind: int
    values: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


def encode(kind: Kind, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> bytes:
    """Return the bytes of a message.

    Args:
        kind: Kind of the message.
        values: Values that JSON can represent.
        arrays: Arrays of type float16, float32, float64, int16, int32 or uint8.

    Raises:
        ValueError: An array has another type, or the message is larger than a reader accepts.
    """
    descriptions, parts = [], []
    for name, array in (arrays or {}).items():
        content: Any = np.asarray(array)
        content = content.astype(content.dtype.newbyteorder("<"), copy=False)
        if content.dtype.str not in _TYPES:
            raise ValueError(f"{name} has type {content.dtype}, which a message can't hold.")
        descriptions.append([name, content.dtype.str, list(content.shape)])
        parts.append(content.tobytes())
    text = json.dumps({"values": dict(values), "arrays": descriptions}).encode()
    content = b"".join((_LENGTH.pack(len(text)), text, *parts))
    if len(content) > _MAX_LENGTH:
        raise ValueError(f"a message of {len(content)} bytes is larger than {_MAX_LENGTH}; send fewer points.")
    packed = zlib.compress(content, _LEVEL)
    return _HEADER.pack(_MAGIC, VERSION, kind, len(packed), len(content), zlib.crc32(packed)) + packed


class MessageReader:
    """Decodes messages from a stream of bytes.

    Args:
        largest: largest length of the content of a message [bytes].
    """

    def __init__(self, largest: int = _MAX_LENGTH) -> None:
        self._largest = largest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes and return the messages that they complete.

        Raises:
            ValueError: The bytes are not messages of this version; the rest of the stream is unusable.
        """
        self._buffer += data
        messages = []
        while len(self._buffer) >= _HEADER.size:
            magic, version, kind, length, size, checksum = _HEADER.unpack_from(self._buffer)
            if magic != _MAGIC:
                raise ValueError("there is no aero-planner node at this address.")
            if version != VERSION:
                raise ValueError(
                    f"the node uses version {version} of the telemetry protocol and this program version {VERSION}; "
                    "install the same release on both."
                )
            if not 0 < length <= self._largest or not _LENGTH.size <= size <= self._largest:
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
        # Bounded by the announced length, however much the stream would expand to.
        content = zlib.decompressobj().decompress(packed, size)
        if len(content) != size:
            raise ValueError("its content is too short")
        (length,) = _LENGTH.unpack_from(content)
        description = parse_json(content[_LENGTH.size : _LENGTH.size + length])
        values, arrays, start = dict(description["values"]), {}, _LENGTH.size + length
        for name, dtype, shape in description["arrays"]:
            if dtype not in _TYPES or not all(isinstance(n, int) and n >= 0 for n in shape):
                raise ValueError(f"array {name!r} has an unknown type or shape")
            count = math.prod(shape)
            arrays[str(name)] = np.frombuffer(content, dtype, count, start).reshape(shape)
            start += count * np.dtype(dtype).itemsize
    except (zlib.error, struct.error, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"a telemetry message is damaged: {error}.") from error
    return Message(kind, values, arrays)
