"""PCD files, decoded with NumPy.

Of the two readers of open3d 0.20, one reads double coordinates as zeros, and the other crashes on some compressed
files.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file, read_user_bytes
from aero_viz.point_times import time_field
from aero_viz.scenes.decoder_checks import check_count, load_rows, read_header

Points = NDArray[np.float64]

_LZF_RATIO_MAX = 88  # a copy of 3 bytes yields at most 264


def read_pcd(path: Path) -> tuple[Points, NDArray[Any] | None]:
    """Return the points of a PCD file [n, 3] [m], and their times [n] as stored, or None.

    Raises:
        Exception: the file is damaged; a ValueError has a text for the user.
    """
    header, size = read_header(
        path, rb"(?s)^.*?(?:^|\n)DATA[ \t]+\w+[ \t]*\r?\n", "it has no PCD header that ends in DATA"
    )
    entries = _entries(header)
    fields, data = [name.lower() for name in entries["FIELDS"]], entries["DATA"][0].lower()
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise ValueError(f"it has no field {missing[0]} among {', '.join(fields)[:100]}")
    present = None
    if data == "ascii":
        present = sum(1 for line in _lines(path, header.count(b"\n")) if line.strip())
    record, points = _layout(entries, fields, size, present)
    counts = [record[i].shape[0] for i in range(len(record.names or ()))]
    formats = ["f8" if data == "ascii" else record[i].base.str for i in range(len(counts))]
    time = time_field(dict(zip(fields, formats, strict=False)))
    used = [fields.index(name) for name in ("x", "y", "z", time) if name is not None]
    if points == 0:
        return np.zeros((0, 3)), None
    if data == "ascii":
        columns = [sum(counts[:i]) for i in used]
        check_count(points, (size + 1) // (2 * sum(counts)))  # a digit and a space for each value
        table: NDArray[Any] = load_rows(_lines(path, header.count(b"\n")), columns, max_rows=points)
        check_count(points, len(table))
        last = next(islice(_lines(path, header.count(b"\n")), points - 1, None), b"")
        if len(last.split()) < sum(counts):
            raise ValueError(f"it is truncated: its last point has {len(last.split())} of {sum(counts)} values")
        return table[:, :3], None if time is None else table[:, 3]
    names = record.names or ()
    if data == "binary":
        check_count(points, size // record.itemsize)
    content = read_user_bytes(path)[len(header) :]
    if data == "binary":
        table = np.frombuffer(content, record, points)
        columns = [table[names[i]][:, 0] for i in used]
        return np.column_stack(columns[:3]), None if time is None else columns[3]
    if data != "binary_compressed":
        raise ValueError(f"its data are {data}; they must be ascii, binary or binary_compressed")
    packed_size, plain_size = struct.unpack_from("<II", content)
    if plain_size != points * record.itemsize or packed_size > size - 8 or plain_size > _LZF_RATIO_MAX * packed_size:
        raise ValueError("its compressed data do not have the size that its header declares")
    check_count(points, points)
    plain = _decompress_lzf(content[8 : 8 + packed_size], plain_size)
    # Compressed data are stored field by field, not point by point.
    columns = []
    for i in used:
        first = points * sum(record[name].itemsize for name in names[:i])
        columns.append(np.frombuffer(plain, record[i].base, points * counts[i], first)[:: counts[i]])
    return np.column_stack(columns[:3]), None if time is None else columns[3]


def _entries(header: bytes) -> dict[str, list[str]]:
    """Return the entries of a header by their keywords."""
    text = "\n".join(line.split("#")[0] for line in header.decode("ascii", "replace").splitlines())
    for keyword in ("SIZE", "WIDTH"):  # a tool of Livox's omits the line breaks before these
        if not re.search(rf"(?m)^[ \t]*{keyword}\s", text):
            text = text.replace(f"{keyword} ", f"\n{keyword} ", 1)
    entries = {row[0]: row[1:] for row in (line.split() for line in text.splitlines()) if row}
    for keyword in ("FIELDS", "DATA"):
        if not entries.get(keyword):
            raise ValueError(f"its header has no {keyword}")
    return entries


def _layout(
    entries: dict[str, list[str]], fields: list[str], size: int, present: int | None
) -> tuple[np.dtype[Any], int]:
    """Return the type of a point, and the number of points.

    Where a header contradicts itself, the reading that fits the data is chosen.

    Args:
        entries: the header.
        fields: names of the fields.
        size: length of the data [bytes].
        present: number of points that the data hold; None where their size says it.
    """
    declared = [int(entries["POINTS"][0])] if entries.get("POINTS") else []
    if entries.get("WIDTH"):
        declared.append(int(entries["WIDTH"][0]) * int((entries.get("HEIGHT") or ["1"])[0]))
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT") or ["1"] * len(fields)
    lengths = {len(fields), len(sizes), len(types), len(counts)}
    if present is not None:
        # Only the columns matter. A number that is declared twice and fits nowhere means a truncated file.
        points = present if not declared or present in declared else declared[0]
        return _record(len(fields), [], [], counts), points
    records = [_record(length, sizes, types, counts) for length in sorted(lengths, reverse=True) if length > 2]
    for record in records:
        for points in declared or [size // record.itemsize]:
            if points * record.itemsize == size:
                return record, points
    if len(lengths) > 1 or not declared:
        raise ValueError("its header is damaged: FIELDS, SIZE, TYPE and COUNT do not fit together")
    return records[0], declared[0]


def _record(length: int, sizes: list[str], types: list[str], counts: list[str]) -> np.dtype[Any]:
    """Return the type of a point with `length` fields. Fields without a description are single float32."""
    rows = [
        (name or "F", width or "4", int(count or "1"))
        for _, name, width, count in zip_longest(range(length), types[:length], sizes[:length], counts[:length])
    ]
    if not rows or min(count for _, _, count in rows) < 1:
        raise ValueError("its header is damaged: COUNT must be positive")
    # Names may repeat, such as the padding "_"; positions do not.
    kinds = [f"<{'f' if name == 'F' else name.lower()}{width}" for name, width, _ in rows]
    return np.dtype([(f"f{i}", kind, (row[2],)) for i, (kind, row) in enumerate(zip(kinds, rows, strict=True))])


def _lines(path: Path, skipped: int) -> Iterator[bytes]:
    """Yield the lines of a file after the first ones."""
    with open_user_file(path) as file:
        yield from islice(file, skipped, None)


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
