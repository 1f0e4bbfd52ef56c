"""A filter in the kernel that drops datagrams of other senders before they take time or room in a socket's buffer."""

from __future__ import annotations

import contextlib
import ctypes
import socket
import struct
from collections.abc import Iterable

_SO_ATTACH_FILTER, _SO_MEMINFO = 26, 55  # socket options of Linux
_DROPS = 8  # index of the dropped datagrams in _SO_MEMINFO
_MAX_SENDERS = 60  # jumps of the filter reach 255 instructions

# Instructions of the classic Berkeley packet filter. The filter of a UDP socket sees the datagram from the UDP header
# on, and the IPv4 header at a separate negative offset.
_LOAD_WORD, _LOAD_HALF, _JUMP_EQUAL, _RETURN = 0x20, 0x28, 0x15, 0x06
_SOURCE_ADDRESS, _SOURCE_PORT = (-0x100000 + 12) & 0xFFFFFFFF, 0
_WHOLE = 0xFFFFFFFF


def filter_senders(sock: socket.socket, senders: Iterable[tuple[str, int | None]]) -> bool:
    """Let only datagrams from these IPv4 addresses and ports into the socket; a port of None stands for all ports.

    Returns:
        True if the system filters. If it does not, the caller's own check must suffice.
    """
    program: list[tuple[int, int, int, int]] = [(_LOAD_WORD, 0, 0, _SOURCE_ADDRESS)]
    with contextlib.suppress(OSError):
        for host, port in list(senders)[:_MAX_SENDERS]:
            (address,) = struct.unpack("!I", socket.inet_aton(host))
            if port is None:
                program += [(_JUMP_EQUAL, 0, 1, address), (_RETURN, 0, 0, _WHOLE)]
            else:
                program += [
                    (_JUMP_EQUAL, 0, 4, address),
                    (_LOAD_HALF, 0, 0, _SOURCE_PORT),
                    (_JUMP_EQUAL, 0, 1, port),
                    (_RETURN, 0, 0, _WHOLE),
                    (_LOAD_WORD, 0, 0, _SOURCE_ADDRESS),
                ]
        program.append((_RETURN, 0, 0, 0))
        code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in program))
        sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("HL", len(program), ctypes.addressof(code)))
        return True
    return False


def count_drops(sock: socket.socket) -> int:
    """Return the number of datagrams that the kernel has dropped, filtered or for lack of room; 0 if it is unknown."""
    with contextlib.suppress(OSError):
        numbers = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_DROPS + 1))
        if len(numbers) == 4 * (_DROPS + 1):
            return int(struct.unpack_from("I", numbers, 4 * _DROPS)[0])
    return 0
