"""Vertices of PLY files, decoded with NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.point_times import time_field
from aero_viz.scenes.decoder_checks import check_count, read_ply_header

_CODES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_CODES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_CODES |= {"float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"}


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """Return the vertices of a PLY file [n, 3] [m], and their times [n] as stored, or None.

    Raises:
        Exception: the file is damaged; a ValueError has a text for the user.
    """
    header, counts = read_ply_header(path)
    vertices = counts.get(b"vertex", 0)
    if not vertices:
        raise ValueError("it has no vertices")
    form, elements = _layout(header)
    names = [name for name, _ in elements]
    before, record = elements[: names.index("vertex")], elements[names.index("vertex")][1]
    size, skipped = path.stat().st_size - len(header), [counts[name.encode()] for name, _ in before]
    if form == "ascii":
        first = sum(count * len(kind.names or ()) for count, (_, kind) in zip(skipped, before, strict=True))
        width = len(record.names or ())
        check_count(vertices, (size + 1) // 2 // max(width, 1))  # a digit and a space for each value
        with open_user_file(path) as file:
            file.seek(len(header))
            values = np.fromfile(file, np.float64, first + vertices * width, sep=" ")
        check_count(vertices, max(len(values) - first, 0) // max(width, 1))
        table = dict(zip(record.names or (), values[first:].reshape(vertices, width).T, strict=True))
    else:
        first = sum(count * kind.itemsize for count, (_, kind) in zip(skipped, before, strict=True))
        check_count(vertices, max(size - first, 0) // max(record.itemsize, 1))
        with open_user_file(path) as file:
            table = np.fromfile(file, record, vertices, offset=len(header) + first)
    plain = {name.lower(): name for name in record.names or ()}
    if missing := [axis for axis in "xyz" if axis not in plain]:
        raise ValueError(f"it has no property {missing[0]} among {', '.join(plain)[:100]}")
    time = time_field({name: record[name].str for name in record.names or ()})
    points = np.column_stack([table[plain[axis]] for axis in "xyz"]).astype(np.float64)
    return points, None if time is None else table[time]


def _layout(header: bytes) -> tuple[str, list[tuple[str, np.dtype[Any]]]]:
    """Return the encoding, and the elements up to the vertices with the type of a row.

    Raises:
        ValueError: a property is of an unknown type, or a list.
    """
    form, elements = "", list[tuple[str, list[tuple[str, str]]]]()
    for words in (line.split() for line in header.decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            if elements and elements[-1][0] == "vertex":
                break
            elements.append((words[1], []))
        elif words[:1] == ["property"]:
            if words[1] not in _CODES:
                raise ValueError(f"a property of its {elements[-1][0]} is a {words[1][:20]}: save it without")
            order = ">" if form == "binary_big_endian" else "<"
            elements[-1][1].append((words[2], order + _CODES[words[1]]))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"its format is {form[:40] or 'not given'}, not ascii or binary")
    return form, [(name, np.dtype(row)) for name, row in elements]
