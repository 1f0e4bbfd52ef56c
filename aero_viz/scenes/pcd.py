"""PCD files, decoded with NumPy.

Of the two readers of open3d 0.20, one reads double coordinates as zeros, and the other crashes on some compressed
files.
"""

from __future__ import annotations

import struct
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.decoder_checks import check_count, read_header

__all__ = ["read_pcd"]

Points = NDArray[np.float64]

_LZF_RATIO_MAX = 88  # a copy of 3 bytes yields at most 264


def read_pcd(path: Path) -> Points:
    """Return the points of a PCD file [n, 3] [m]; raises an exception where it is damaged."""
    header, size = read_header(
        path, rb"(?s)^.*?(?:^|\n)DATA[ \t]+\w+[ \t]*\r?\n", "it has no PCD header that ends in DATA"
    )
    rows = [line.split("#")[0].split() for line in header.decode("ascii", "replace").splitlines()]
    entries = {row[0]: row[1:] for row in rows if row}
    fields, sizes, types, data = entries["FIELDS"], entries["SIZE"], entries["TYPE"], entries["DATA"][0]
    counts = [int(n) for n in entries.get("COUNT", ["1"] * len(fields))]
    points = int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise ValueError(f"it has no field {missing[0]} among {', '.join(fields)[:100]}")
    if not len(fields) == len(sizes) == len(types) == len(counts) or min(counts) < 1:
        raise ValueError("its header is damaged: FIELDS, SIZE, TYPE and COUNT do not fit together")
    axes = [fields.index(axis) for axis in "xyz"]
    if points == 0:
        return np.zeros((0, 3))
    if data == "ascii":
        columns = [sum(counts[:i]) for i in axes]
        check_count(points, (size + 1) // (2 * sum(counts)))  # a digit and a space for each value
        table: NDArray[Any] = np.loadtxt(path, skiprows=header.count(b"\n"), usecols=columns, max_rows=points, ndmin=2)
        check_count(points, len(table))
        last = _line(path, header.count(b"\n") + points)
        if len(last.split()) < sum(counts):
            raise ValueError(f"it is truncated: its last point has {len(last.split())} of {sum(counts)} values")
        return table
    # Names may repeat, such as the padding "_"; positions do not.
    names = [f"f{i}" for i in range(len(fields))]
    kinds = [f"<{'f' if t == 'F' else t.lower()}{n}" for t, n in zip(types, sizes, strict=True)]
    record = np.dtype([(name, kind, (n,)) for name, kind, n in zip(names, kinds, counts, strict=True)])
    if data == "binary":
        check_count(points, size // record.itemsize)
    content = path.read_bytes()[len(header) :]
    if data == "binary":
        table = np.frombuffer(content, record, points)
        return np.column_stack([table[names[i]][:, 0] for i in axes])
    if data != "binary_compressed":
        raise ValueError(f"its data are {data}; they must be ascii, binary or binary_compressed")
    packed_size, plain_size = struct.unpack_from("<II", content)
    if plain_size != points * record.itemsize or packed_size > size - 8 or plain_size > _LZF_RATIO_MAX * packed_size:
        raise ValueError("its compressed data do not have the size that its header declares")
    check_count(points, points)
    plain = _decompress_lzf(content[8 : 8 + packed_size], plain_size)
    # Compressed data are stored field by field, not point by point.
    columns = []
    for i in axes:
        first = points * sum(record[name].itemsize for name in names[:i])
        columns.append(np.frombuffer(plain, kinds[i], points * counts[i], first)[:: counts[i]])
    return np.column_stack(columns)


def _line(path: Path, number: int) -> bytes:
    """Return a line of a file, counted from 1."""
    with path.open("rb") as file:
        return next(islice(file, number - 1, None), b"")


def _decompress_lzf(packed: bytes, size: int) -> bytes:
    """Decompress LZF (Lehmann): runs of literal bytes, and copies of earlier output that may overlap themselves."""
    plain = bytearray()
    i = 0
    while i < len(packed):
        control = packed[i]
        i += 1
        if control < 32:
            plain += packed[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[i]
            i += 1
        length += 2
        start = len(plain) - ((control & 31) << 8) - packed[i] - 1
        i += 1
        if start < 0:
            raise ValueError("its compressed data are damaged")
        copied = plain[start : start + length]
        plain += (copied * (length // len(copied) + 1))[:length] if len(copied) < length else copied
    if len(plain) != size:
        raise ValueError(f"its compressed data hold {len(plain)} bytes, and the header declares {size}")
    return bytes(plain)
