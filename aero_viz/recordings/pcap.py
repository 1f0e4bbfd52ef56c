"""Captures of network packets (.pcap)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError

PCAP_MAGICS = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d")
"""Starts of captures: little and big endian with microseconds, and with nanoseconds."""

_LINKS = {1: 14, 101: 0, 113: 16, 228: 0}
"""Length of the header before IPv4 [bytes]: Ethernet, raw, Linux cooked, IPv4."""
_FRAME_MAX = 1 << 18


class Datagram(NamedTuple):
    time: int
    """Time of capture [ns]."""
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
    with open_user_file(path) as file:
        head = file.read(24)
        if len(head) < 24:
            raise UserError(f"{path} is truncated in its header and holds no packets: capture or copy it again.")
        order = "<" if head[:4] in (PCAP_MAGICS[0], PCAP_MAGICS[2]) else ">"
        unit = 1 if head[:4] in PCAP_MAGICS[2:] else 1000
        link = struct.unpack(f"{order}I", head[20:24])[0] & 0xFFFF
        if link not in _LINKS:
            raise UserError(f"{path} is a capture of link type {link}; capture on an Ethernet interface.")
        while record := file.read(16):
            if len(record) < 16:
                raise EOFError
            seconds, fraction, length, _ = struct.unpack(f"{order}4I", record)
            if length > _FRAME_MAX:
                raise ValueError(f"damaged, a frame claims {length} bytes: only the data before it is used")
            frame = file.read(length)
            if len(frame) < length:
                raise EOFError
            ip = frame[_LINKS[link] :]
            if link == 1 and frame[12:14] == b"\x81\x00":  # VLAN
                ip = frame[18:]
            if len(ip) < 28 or ip[0] >> 4 != 4 or ip[9] != 17 or (ip[6] & 0x1F) or ip[7]:
                continue
            size = 4 * (ip[0] & 15)
            port, udp = struct.unpack_from(">HH", ip, size + 2) if len(ip) >= size + 8 else (0, 0)
            yield Datagram(seconds * 10**9 + fraction * unit, port, ip[size + 8 : size + udp])
