"""MAVLink messages from received bytes, whatever is lost, damaged or inserted between them.

Frames are found here, in time linear in the number of bytes; pymavlink decodes only those that are wanted. The headers
are looked at first: a frame from another system or of another kind costs almost nothing.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

from aero_planner.onboard.mavlink_signing import SignatureChecker

_V1, _V2 = 0xFE, 0xFD  # first byte of a frame
_MARKER = re.compile(b"[\xfd\xfe]")
_SIGNED = 1  # the only flag of a frame's header that is understood
_SIGNATURE_LENGTH = 13
_MAX_RETRIES = 32  # frames with a wrong checksum, per call, whose bytes are searched for other frames


class MavlinkParser:
    """Finds the frames in received bytes and decodes those that are wanted.

    Args:
        dialect: pymavlink's module of messages.
        datagrams: True if each part holds whole frames; False for a stream of bytes.
        wanted: Names of the messages to decode; None decodes all.
        systems: System ids whose messages are decoded; None decodes those of all systems.
        signatures: Checks the signatures, without which no message is accepted; None accepts all.

    Attributes:
        bad: Number of parts of the input that were no message: wrong checksum, or garbage.
        skipped: Number of frames that were not wanted.
        unsigned: Number of frames without a valid signature.
    """

    def __init__(
        self,
        dialect: Any,
        *,
        datagrams: bool,
        wanted: Collection[str] | None = None,
        systems: Collection[int] | None = None,
        signatures: SignatureChecker | None = None,
    ) -> None:
        self.bad = self.skipped = self.unsigned = 0
        self._dialect = dialect
        self._kinds = dialect.mavlink_map
        self._wanted = {number for number, kind in self._kinds.items() if wanted is None or kind.msgname in wanted}
        self._systems = None if systems is None else frozenset(systems)
        self._datagrams = datagrams
        self._signatures = signatures
        self._buffer = b""
        self._decoder = dialect.MAVLink(None)

    @property
    def buffered(self) -> int:
        """Number of bytes that are kept until the rest of their frame arrives."""
        return len(self._buffer)

    def parse(self, data: bytes) -> list[Any]:
        """Return the wanted messages that `data` completes. Never raises."""
        messages: list[Any] = []
        if self._datagrams:
            self._parse_datagram(messages, bytes(data))
        else:
            self._buffer = self._parse_stream(messages, self._buffer + data)
        return messages

    def _parse_datagram(self, messages: list[Any], data: bytes) -> None:
        """Decode a datagram up to the first byte that does not begin a whole frame."""
        position = 0
        while position < len(data):
            length = _frame_length(data, position)
            if not 0 < length <= len(data) - position:
                self.bad += 1
                return
            self._handle_frame(messages, data[position : position + length])
            position += length

    def _parse_stream(self, messages: list[Any], data: bytes) -> bytes:
        """Decode all frames in `data` and return the bytes after the last one."""
        position, retries = 0, _MAX_RETRIES
        while True:
            marker = _MARKER.search(data, position)
            start = marker.start() if marker is not None else len(data)
            self.bad += start > position
            length = _frame_length(data, start)
            if start == len(data) or length == 0 or length > len(data) - start:
                return data[start:]
            if length < 0:
                position = start + 1
                self.bad += 1
                continue
            end = start + length
            if self._handle_frame(messages, data[start:end], data[end : end + 1]) or retries == 0:
                position = end
            else:
                position, retries = start + 1, retries - 1  # a stray marker may have claimed the bytes after it

    def _handle_frame(self, messages: list[Any], frame: bytes, following: bytes = b"") -> bool:
        """Decode a frame if it is wanted; return False if it is none.

        `following` is the byte after it in a stream, if that has arrived.
        """
        is_v2 = frame[0] == _V2
        system, number = (frame[5], int.from_bytes(frame[7:10], "little")) if is_v2 else (frame[3], frame[5])
        if number not in self._wanted or (self._systems is not None and system not in self._systems):
            if not self._datagrams and not self._is_genuine(frame, number, following):
                self.bad += 1
                return False
            self.skipped += 1
            return True
        try:
            message = self._decoder.decode(bytearray(frame))
        except Exception:  # pymavlink may raise anything for bytes from the network
            self.bad += 1
            return False
        if self._signatures is not None and not self._signatures.accept(frame):
            self.unsigned += 1
        else:
            messages.append(message)
        return True

    def _is_genuine(self, frame: bytes, number: int, following: bytes) -> bool:
        """Return False if a frame in a stream is noise: by its checksum or, if that is unknown, by what follows it."""
        if number not in self._kinds:
            return not following or _MARKER.match(following) is not None
        end = len(frame) - (_SIGNATURE_LENGTH if frame[0] == _V2 and frame[2] & _SIGNED else 0)
        expected = self._dialect.x25crc(frame[1 : end - 2] + bytes([self._kinds[number].crc_extra])).crc
        return expected == int.from_bytes(frame[end - 2 : end], "little")


def _frame_length(data: bytes, start: int) -> int:
    """Return the length of the frame that begins at `start`, 0 if that is not known yet, -1 if none begins there."""
    if start >= len(data):
        return 0
    if data[start] == _V1:
        return 8 + data[start + 1] if start + 1 < len(data) else 0
    if data[start] != _V2:
        return -1
    if start + 2 >= len(data):
        return 0
    if data[start + 2] & ~_SIGNED:
        return -1
    return 12 + data[start + 1] + (_SIGNATURE_LENGTH if data[start + 2] & _SIGNED else 0)
