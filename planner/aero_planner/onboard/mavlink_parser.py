"""MAVLink messages from received bytes, whatever is lost, damaged or inserted between them."""

from __future__ import annotations

from typing import Any

__all__ = ["MavlinkParser"]

_MARKERS = (0xFD, 0xFE)  # first byte of a message, versions 2 and 1
_MAX_RETRIES = 32  # after stray markers, per call


class MavlinkParser:
    """Wraps pymavlink's parser, which by itself grows without bound, raises, and skips messages after stray markers.

    Args:
        dialect: pymavlink's module of messages.
        datagrams: True if each part holds whole messages; False for a stream of bytes.

    Attributes:
        bad: Number of parts of the input that were no message: wrong checksum, or garbage.
    """

    def __init__(self, dialect: Any, *, datagrams: bool) -> None:
        self.bad = 0
        self._dialect = dialect
        self._datagrams = datagrams
        self._protocol = self._new_protocol()

    @property
    def buffered(self) -> int:
        """Number of bytes that are kept until the rest of their message arrives."""
        return self._protocol.buf_len()

    def parse(self, data: bytes) -> list[Any]:
        """Return the messages that `data` completes. Never raises."""
        messages: list[Any] = []
        try:
            self._parse_into(messages, data)
        except Exception:  # pymavlink may raise anything for bytes from the network
            self.bad += 1
            self._protocol = self._new_protocol()
            return messages
        protocol = self._protocol
        if protocol.buf_index:  # pymavlink discards what it has read only when it has read everything
            del protocol.buf[: protocol.buf_index]
            protocol.buf_index = 0
        if self._datagrams and protocol.buf_len():  # the rest of a damaged datagram must not swallow the next one
            self._protocol = self._new_protocol()
            self.bad += 1
        return messages

    def _parse_into(self, messages: list[Any], data: bytes) -> None:
        protocol = self._protocol
        message = protocol.parse_char(data)
        retries = 0 if self._datagrams else _MAX_RETRIES
        while message is not None:
            if message.get_type() != "BAD_DATA":
                messages.append(message)
            else:
                self.bad += 1
                if retries and len(message.data) > 1 and message.data[0] in _MARKERS:
                    # A stray marker in the stream claimed the bytes after it: parse these once more.
                    retries -= 1
                    protocol.buf[protocol.buf_index : protocol.buf_index] = message.data[1:]
            message = protocol.parse_char(b"")

    def _new_protocol(self) -> Any:
        protocol = self._dialect.MAVLink(None)
        protocol.robust_parsing = True
        return protocol
