"""Non-blocking byte transport to an autopilot: UDP, or a serial device through the system's terminal interface."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Collection
from typing import Protocol

from aero_planner.onboard.datagram_filter import count_drops, filter_senders

_log = logging.getLogger(__name__)

Address = tuple[str, int]
"""Host and UDP port."""

_CHUNK = 4096
_TOLERATED = 20  # datagrams of unknown senders after which the kernel drops them
_LOGGED_SENDERS = 5


class Transport(Protocol):
    """A connection that never blocks."""

    datagrams: bool
    """True if each `receive` returns whole messages; False for a stream of bytes."""
    sender: str | None
    """Address from which the last received data came; None if it came from the peer, or if the peer is unknown."""

    @property
    def peer(self) -> str | None:
        """Destination of `send`, in the form that `open_transport` takes, so that another process can send there, too.

        None while it is unknown.
        """
        ...

    @property
    def dropped_datagrams(self) -> int:
        """Number of datagrams that were dropped: from unknown senders, or for lack of room."""
        ...

    def receive(self) -> bytes | None:
        """Return the next part of the received data, oldest first; None if there is nothing left.

        It is empty if it came from neither the peer, once that is known, nor an allowed address.
        """
        ...

    def accept_sender(self) -> None:
        """Make the sender of the last received data the peer, for good, unless there is a peer already."""
        ...

    @property
    def reply_address(self) -> Address | None:
        """Address to which an answer to the last received data goes; None for the peer."""
        ...

    def send(self, data: bytes, address: Address | None = None) -> bool:
        """Send to the peer, or to a reply address; return False if there is no peer yet, or no room."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...


def open_transport(url: str, *, baud: int | None = 921_600, allowed: Collection[str] = ()) -> Transport:
    """Open "udpin:ADDRESS:PORT", "udpout:ADDRESS:PORT" or a serial device such as "/dev/ttyTHS1".

    Args:
        url: Address or device to open.
        baud: Baud rate of a serial device [bit/s]. None keeps the device's settings and buffers, for a device that
            another process has already opened.
        allowed: Addresses other than the peer from which datagrams are received.

    Raises:
        ValueError: The URL has another form, or the system does not support the baud rate.
        OSError: The address or the device can't be used.
    """
    kind, _, rest = url.partition(":")
    if kind in ("udpin", "udpout"):
        host, _, number = rest.rpartition(":")
        if not host or not number.isdigit() or int(number) > 65535:
            raise ValueError(f"the connection {url!r} has no address and port; write it as {kind}:127.0.0.1:14540.")
        return _Udp(host, int(number), listen=kind == "udpin", allowed=allowed)
    if url.startswith("/"):
        return _Serial(url, baud)
    raise ValueError(
        f"the connection {url!r} is not understood; "
        "write udpin:ADDRESS:PORT, udpout:ADDRESS:PORT or a serial device such as /dev/ttyTHS1."
    )


class _Udp:
    datagrams = True

    def __init__(self, host: str, port: int, *, listen: bool, allowed: Collection[str]) -> None:
        self.sender: str | None = None
        self._peer = None if listen else (socket.gethostbyname(host), port)
        self._allowed = frozenset(socket.gethostbyname(name) for name in allowed)
        self._last_sender: tuple[str, int] | None = None
        self._unknown_senders: set[tuple[str, int]] = set()
        self._refused = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind((host, port) if listen else ("", 0))
        except BaseException:
            self._socket.close()
            raise

    @property
    def peer(self) -> str | None:
        return None if self._peer is None else f"udpout:{self._peer[0]}:{self._peer[1]}"

    @property
    def dropped_datagrams(self) -> int:
        return self._refused + count_drops(self._socket)

    def receive(self) -> bytes | None:
        try:
            data, sender = self._socket.recvfrom(_CHUNK)
        except OSError:  # nothing has arrived, or an earlier datagram has caused an error
            return None
        self._last_sender = sender
        if self._peer is None or sender == self._peer:
            self.sender = None
            return data
        self.sender = sender[0]
        if sender[0] in self._allowed:
            return data
        self._refuse(sender)
        return b""

    def _refuse(self, sender: tuple[str, int]) -> None:
        """Count a datagram of an unknown sender, log the first such senders, and later let the kernel drop them."""
        assert self._peer is not None
        self._refused += 1
        if sender not in self._unknown_senders and len(self._unknown_senders) < _LOGGED_SENDERS:
            self._unknown_senders.add(sender)
            _log.warning("datagrams from %s:%d are ignored: the autopilot is at %s:%d", *sender, *self._peer)
        if self._refused == _TOLERATED:
            filter_senders(self._socket, [self._peer, *((host, None) for host in self._allowed)])

    def accept_sender(self) -> None:
        if self._peer is None and self._last_sender is not None:
            self._peer = self._last_sender
            _log.info("the autopilot is at %s:%d", *self._peer)

    @property
    def reply_address(self) -> Address | None:
        return None if self.sender is None else self._last_sender

    def send(self, data: bytes, address: Address | None = None) -> bool:
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, address or self._peer)
        except OSError:  # no room, or no listener: the stream of commands ends, which the autopilot notices
            return False
        return True

    def close(self) -> None:
        self._socket.close()


class _Serial:
    datagrams = False
    sender: str | None = None
    reply_address: Address | None = None

    def __init__(self, device: str, baud: int | None) -> None:
        self.peer = device
        self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if baud is not None:
            try:
                self._configure(baud)
            except BaseException:
                os.close(self._file)
                raise

    def _configure(self, baud: int) -> None:
        """Pass raw bytes, 8N1, without flow control or waiting, and discard the device's buffers."""
        import termios

        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise ValueError(f"this system does not support the baud rate {baud}; use one such as 921600.")
        try:
            attributes = termios.tcgetattr(self._file)
            attributes[0] = attributes[1] = attributes[3] = 0
            attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
            attributes[4] = attributes[5] = speed
            attributes[6][termios.VMIN] = attributes[6][termios.VTIME] = 0
            termios.tcsetattr(self._file, termios.TCSANOW, attributes)
            termios.tcflush(self._file, termios.TCIOFLUSH)
        except termios.error as error:
            raise OSError(f"{self.peer} is not a serial device: {error.args[-1]}") from error

    @property
    def dropped_datagrams(self) -> int:
        return 0

    def receive(self) -> bytes | None:
        with contextlib.suppress(OSError):
            return os.read(self._file, _CHUNK) or None
        return None

    def accept_sender(self) -> None:
        pass

    def send(self, data: bytes, address: Address | None = None) -> bool:
        with contextlib.suppress(OSError):
            return os.write(self._file, data) == len(data)
        return False

    def close(self) -> None:
        os.close(self._file)
