"""Bytes to and from an autopilot: UDP, or a serial device through the operating system's own terminal interface."""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Protocol

__all__ = ["Transport", "open_transport"]

_CHUNK = 4096


class Transport(Protocol):
    """A connection that never blocks."""

    datagrams: bool
    """True when what one `receive` returns holds whole messages; False for a stream of bytes."""

    @property
    def partner(self) -> str | None:
        """Where `send` goes, as `open_transport` takes it, so that another process can; None while there is nobody."""
        ...

    def receive(self) -> bytes | None:
        """Return what has arrived, oldest first, a part at a time; None when there is nothing more."""
        ...

    def accept(self) -> None:
        """Say that what came last is from the partner: from now on `send` goes there."""
        ...

    def send(self, data: bytes) -> bool:
        """Send; return False when there is no partner yet, or no room."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...


def open_transport(url: str, *, baud: int | None = 921_600) -> Transport:
    """Open "udpin:ADDRESS:PORT", "udpout:ADDRESS:PORT" or a serial device such as "/dev/ttyTHS1".

    Args:
        url: what to open.
        baud: of a serial device [bit/s]; None leaves its settings and what it holds as they are, for a device that
            another process has open, too.

    Raises:
        ValueError: the URL has another form, or the baud rate is none that the system knows.
        OSError: the address or the device can't be used.
    """
    kind, _, rest = url.partition(":")
    if kind in ("udpin", "udpout"):
        host, _, number = rest.rpartition(":")
        if not host or not number.isdigit() or int(number) > 65535:
            raise ValueError(f"the connection {url!r} has no address and port; write it as {kind}:127.0.0.1:14540.")
        return _Udp(host, int(number), listen=kind == "udpin")
    if url.startswith("/"):
        return _Serial(url, baud)
    raise ValueError(
        f"the connection {url!r} is not understood; "
        "write udpin:ADDRESS:PORT, udpout:ADDRESS:PORT or a serial device such as /dev/ttyTHS1."
    )


class _Udp:
    datagrams = True

    def __init__(self, host: str, port: int, *, listen: bool) -> None:
        self._partner = None if listen else (host, port)
        self._fixed = not listen
        self._last: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            if listen:
                self._socket.bind((host, port))
            else:
                self._socket.bind(("", 0))
        except BaseException:
            self._socket.close()
            raise

    @property
    def partner(self) -> str | None:
        return None if self._partner is None else f"udpout:{self._partner[0]}:{self._partner[1]}"

    def receive(self) -> bytes | None:
        try:
            data, self._last = self._socket.recvfrom(65535)
        except OSError:  # nothing there, or an error that an earlier datagram left behind
            return None
        return data

    def accept(self) -> None:
        if not self._fixed:
            self._partner = self._last

    def send(self, data: bytes) -> bool:
        if self._partner is None:
            return False
        try:
            self._socket.sendto(data, self._partner)
        except OSError:  # no room, or nobody listens: the stream of commands ends, and the autopilot notices
            return False
        return True

    def close(self) -> None:
        self._socket.close()


class _Serial:
    datagrams = False

    def __init__(self, device: str, baud: int | None) -> None:
        self.partner = device
        self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        if baud is not None:
            try:
                self._set_up(baud)
            except BaseException:
                os.close(self._file)
                raise

    def _set_up(self, baud: int) -> None:
        """Make the device pass raw bytes, 8N1, no flow control, no waiting, and forget what it holds."""
        import termios

        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise ValueError(f"the baud rate {baud} is none that this system knows; use one such as 921600.")
        try:
            attributes = termios.tcgetattr(self._file)
            attributes[0] = attributes[1] = attributes[3] = 0
            attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
            attributes[4] = attributes[5] = speed
            attributes[6][termios.VMIN] = attributes[6][termios.VTIME] = 0
            termios.tcsetattr(self._file, termios.TCSANOW, attributes)
            termios.tcflush(self._file, termios.TCIOFLUSH)
        except termios.error as error:
            raise OSError(f"{self.partner} is no serial device: {error.args[-1]}") from error

    def receive(self) -> bytes | None:
        with contextlib.suppress(OSError):
            return os.read(self._file, _CHUNK) or None
        return None

    def accept(self) -> None:
        pass

    def send(self, data: bytes) -> bool:
        with contextlib.suppress(OSError):
            return os.write(self._file, data) == len(data)
        return False

    def close(self) -> None:
        os.close(self._file)
