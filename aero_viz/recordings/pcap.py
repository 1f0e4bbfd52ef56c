"""Captures of network packets (.pcap and .pcapng)."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError

_CLASSIC = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d")
"""Starts of captures: little and big endian with microseconds, and with nanoseconds."""
_NG = b"\x0a\x0d\x0d\x0a"
PCAP_MAGICS = (*_CLASSIC, _NG)
"""Starts of captures."""

ETHERNET = 1
_HEADERS = {ETHERNET: (14, 12), 113: (16, 14), 276: (20, 0), 12: (0, None), 14: (0, None), 101: (0, None)}
_HEADERS |= {228: (0, None), 229: (0, None), 0: (4, None), 108: (4, None)}
"""Length of the header before IP, and where in it the type of what follows is [bytes], by the type of the link:
Ethernet, Linux cooked (`tcpdump -i any`) in versions 1 and 2, raw IP in its numbers, IPv4, IPv6, loopback."""
_VLAN = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")
_FRAME_MAX = 1 << 18
_UDP = 17
_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
"""Types of the blocks of a .pcapng."""
_RESOLUTION = 9
"""Option of an interface: the unit of its times."""


class Frame(NamedTuple):
    """A packet as it was captured."""

    time: int
    """Time of capture [ns]."""
    link: int
    """Type of its link."""
    data: bytes


class Datagram(NamedTuple):
    """A packet of UDP."""

    time: int
    """Time of capture [ns]."""
    source: str
    """Address of the sender."""
    port: int
    """Destination."""
    payload: bytes


def udp_payloads(path: Path) -> Iterator[Datagram]:
    """Yield the UDP datagrams of a capture. Of those that were fragmented, the first fragment is yielded.

    Raises:
        UserError: the capture has a link type that is not supported.
        EOFError: it is truncated.
        ValueError: it is damaged.
    """
    for frame in frames(path):
        ip = ip_packet(frame)
        if ip[:1] and ip[0] >> 4 == 4 and len(ip) >= 28 and ip[9] == _UDP and not (ip[6] & 0x1F or ip[7]):
            size, source = 4 * (ip[0] & 15), socket.inet_ntoa(ip[12:16])
        elif ip[:1] and ip[0] >> 4 == 6 and len(ip) >= 48 and ip[6] == _UDP:
            size, source = 40, socket.inet_ntop(socket.AF_INET6, ip[8:24])
        else:
            continue
        port, udp = struct.unpack_from(">HH", ip, size + 2) if len(ip) >= size + 8 else (0, 0)
        yield Datagram(frame.time, source, port, ip[size + 8 : size + udp])


def ip_packet(frame: Frame) -> bytes:
    """Return the packet of IP in a frame, without the headers of its link and of VLANs; empty for another one."""
    size, at = _HEADERS[frame.link]
    if at is not None:
        kind = frame.data[at : at + 2]
        while kind in _VLAN:
            kind, size = frame.data[size + 2 : size + 4], size + 4
        if kind not in (b"\x08\x00", b"\x86\xdd"):
            return b""
    return frame.data[size:]


def frames(path: Path) -> Iterator[Frame]:
    """Yield the packets of a capture.

    Raises:
        UserError, EOFError, ValueError: as for `udp_payloads`.
    """
    with open_user_file(path) as file:
        head = file.read(24)
        if len(head) < 24:
            raise UserError(f"{path} is truncated in its header and holds no packets: capture or copy it again.")
        file.seek(0)
        for frame in _ng_frames(file) if head.startswith(_NG) else _classic_frames(file):
            if frame.link not in _HEADERS:
                raise UserError(f"{path} is a capture of link type {frame.link}; capture on an Ethernet interface.")
            yield frame


def _classic_frames(file: BinaryIO) -> Iterator[Frame]:
    head = file.read(24)
    order = "<" if head[:4] in (_CLASSIC[0], _CLASSIC[2]) else ">"
    unit = 1 if head[:4] in _CLASSIC[2:] else 1000
    link = struct.unpack(f"{order}I", head[20:24])[0] & 0xFFFF
    while record := file.read(16):
        if len(record) < 16:
            raise EOFError
        seconds, fraction, length, _ = struct.unpack(f"{order}4I", record)
        yield Frame(seconds * 10**9 + fraction * unit, link, _content(file, length))


def _content(file: BinaryIO, length: int) -> bytes:
    if length > _FRAME_MAX:
        raise ValueError(f"damaged, a frame claims {length} bytes: only the data before it is used")
    data = file.read(length)
    if len(data) < length:
        raise EOFError
    return data


def _ng_frames(file: BinaryIO) -> Iterator[Frame]:
    order, interfaces, time = "<", [], 0
    while head := file.read(8):
        if len(head) < 8:
            raise EOFError
        if head[:4] == _NG:
            order, interfaces = "<" if file.read(4) == b"\x4d\x3c\x2b\x1a" else ">", []
            file.seek(-4, 1)
        kind, length = struct.unpack(f"{order}2I", head)
        if length < 12 or length % 4:
            raise ValueError(f"damaged, a block claims {length} bytes: only the data before it is used")
        body = _content(file, length - 8)[:-4]
        try:
            if kind == _INTERFACE:
                interfaces.append((struct.unpack_from(f"{order}H", body)[0], _resolution(body[8:], order)))
            elif kind == _ENHANCED:
                number, high, low, size = struct.unpack_from(f"{order}4I", body)
                link, unit = interfaces[number]
                time = (high << 32 | low) * 10**9 // unit
                yield Frame(time, link, body[20 : 20 + size])
            elif kind == _SIMPLE:  # without a time
                yield Frame(time, interfaces[0][0], body[4:])
        except (struct.error, IndexError) as error:
            raise ValueError("damaged, a block contradicts itself: only the data before it is used") from error


def _resolution(options: bytes, order: str) -> int:
    """Return how many units of the times of an interface make a second."""
    while len(options) >= 4:
        code, length = struct.unpack_from(f"{order}2H", options)
        if code == _RESOLUTION and length >= 1 and len(options) > 4:
            exponent = options[4] & 0x7F
            return 2 ** min(exponent, 63) if options[4] & 0x80 else 10 ** min(exponent, 18)
        if code == 0:
            break
        options = options[4 + length + -length % 4 :]
    return 10**6


def write_ethernet(path: Path, target: Path) -> None:
    """Write the packets of IP in a capture as a .pcap of Ethernet, as far as it can be read."""
    with target.open("wb") as file:
        file.write(_CLASSIC[2] + struct.pack("<2H4I", 2, 4, 0, 0, _FRAME_MAX, ETHERNET))
        try:
            for frame in frames(path):
                if ip := ip_packet(frame):
                    kind = b"\x08\x00" if ip[0] >> 4 == 4 else b"\x86\xdd"
                    data = bytes(12) + kind + ip
                    seconds, rest = divmod(frame.time, 10**9)
                    file.write(struct.pack("<4I", seconds & 0xFFFFFFFF, rest, len(data), len(data)) + data)
        except (EOFError, ValueError):
            return  # reported by whoever reads the sweeps
