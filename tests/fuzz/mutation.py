"""Seeded damage to bytes: cuts, flipped bits, impossible numbers, and blocks that are lost, repeated or exchanged."""

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

_LENGTH = struct.Struct("<I")

_EXTREMES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**40, 2**63 - 1, 2**64 - 1)
_TEXTS = (b"0", b"-1", b"1000000000000", b"4294967296", b"1e308", b"nan", b"inf", b"1e30", b"", b"9" * 400)


def mutate(content: bytes, random: np.random.Generator) -> bytes:
    """Return a damaged copy."""
    data = bytearray(content)
    for _ in range(int(random.integers(1, 4))):
        if not data:
            break
        at, length = int(random.integers(len(data))), int(random.integers(1, 65))
        match int(random.integers(10)):
            case 0:
                del data[at:]
            case 1:
                data[at] ^= 1 << int(random.integers(8))
            case 2:
                data[at : at + length] = random.bytes(len(data[at : at + length]))
            case 3 | 4:  # headers are at the start
                at = at if random.integers(2) else at % 512 % len(data)
                size = int(random.choice([1, 2, 4, 8]))
                value = int(_EXTREMES[random.integers(len(_EXTREMES))]) & ((1 << 8 * size) - 1)
                data[at : at + size] = value.to_bytes(size, "little" if random.integers(4) else "big")
            case 5 | 6:
                numbers = list(re.finditer(rb"\d+", bytes(data[: 1 << 16])))
                if numbers:
                    found = numbers[int(random.integers(min(len(numbers), 40 if random.integers(2) else len(numbers))))]
                    data[found.start() : found.end()] = _TEXTS[random.integers(len(_TEXTS))]
            case 7:
                del data[at : at + length * int(random.integers(1, 30))]
            case 8:
                data[at:at] = data[at : at + length * int(random.integers(1, 30))]
            case 9:
                other = int(random.integers(len(data)))
                data[at : at + length] = data[other : other + length]
    return bytes(data)


def pack(parts: Sequence[bytes]) -> bytes:
    """Return the content of a file with these datagrams or messages."""
    return b"".join(_LENGTH.pack(len(part)) + part for part in parts)


def unpack(path: Path) -> list[bytes]:
    """Return the parts in a file that `pack` made."""
    content, parts, at = path.read_bytes(), [], 0
    while at < len(content):
        (size,) = _LENGTH.unpack_from(content, at)
        parts.append(content[at + _LENGTH.size : at + _LENGTH.size + size])
        at += _LENGTH.size + size
    return parts
