"""Points from files, decoded by laspy (LAS, LAZ), pye57 (E57) and NumPy; triangles by `mesh_decoder`.

Run it in a separate process, see `decoding_process`. The libraries are imported on first use. They trust the counts in
a header, so counts are compared with the size of the file before anything is allocated, and with what was read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.point_times import time_field
from aero_viz.scenes.decoder_checks import check_count, read_ply_header
from aero_viz.scenes.e57 import read_e57
from aero_viz.scenes.las import read_las
from aero_viz.scenes.mesh_decoder import read_triangles
from aero_viz.scenes.pcd import read_pcd
from aero_viz.scenes.ply import read_ply
from aero_viz.scenes.text_cloud import TEXT_SUFFIXES, read_text

_COLUMNS_MAX = 8
"""Largest number of columns of a cloud; an array with more has one point per column instead."""
_NPY_HEADER_MAX = 1 << 16  # [bytes]
Points = NDArray[np.float64]
Times = NDArray[Any]


def decode(path: Path, content: str) -> Points:
    """Return the points [n, 3] or triangles [n, 9] of a file [m], without those that are not finite.

    Args:
        path: its suffix names the format.
        content: "points"; "mesh" for its triangles, none where a format of points has none; "any" for the triangles
            or, without any, the points.

    Raises:
        Exception: the file is damaged or truncated; a ValueError has a text for the user.
    """
    reader = _READERS.get(path.suffix.lower())
    if content != "points" and (reader is None or _has_faces(path)):
        return read_triangles(path)
    if content == "mesh" or reader is None:
        return np.zeros((0, 9))
    return decode_points(path)[0]


def decode_points(path: Path, suffix: str | None = None) -> tuple[Points, Times | None]:
    """Return the finite points of a file [n, 3] [m], and their times [n] as stored, or None.

    Args:
        path: the file.
        suffix: names the format; None takes that of the path.

    Raises:
        Exception: as for `decode`.
    """
    table, times = _READERS[(suffix or path.suffix).lower()](path)
    points = np.ascontiguousarray(table, np.float64)
    is_finite = np.isfinite(points).all(axis=1)
    if is_finite.all():
        return points, times
    return points[is_finite], None if times is None else times[is_finite]


def _read_npy(path: Path) -> tuple[Points, Times | None]:
    with open_user_file(path) as file:
        version = np.lib.format.read_magic(file)
        length = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
        if version not in ((1, 0), (2, 0), (3, 0)) or length > min(path.stat().st_size, _NPY_HEADER_MAX):
            raise ValueError("its header is damaged")
        file.seek(len(np.lib.format.MAGIC_PREFIX) + 2)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read(file)
        here = file.tell()
        present = file.seek(0, 2) - here
        file.seek(here)
        if dtype.names is not None and not dtype.hasobject:
            count = math.prod(shape)
            check_count(count, present // dtype.itemsize)
            return _named_columns(np.fromfile(file, dtype, count))
        if len(shape) == 3 and not is_fortran:  # an organised cloud
            shape = (shape[0] * shape[1], shape[2])
        if len(shape) != 2 or shape[1] < 3 or dtype.kind not in "fiu":
            raise ValueError("it must hold one array of numbers with columns x, y, z, or with fields of these names")
        check_count(shape[0], present // (shape[1] * dtype.itemsize))
        table = np.fromfile(file, dtype, shape[0] * shape[1])
    table = table.reshape(shape[::-1]).T if is_fortran else table.reshape(shape)
    if 3 <= len(table) <= _COLUMNS_MAX < table.shape[1]:  # one row per coordinate
        table = table.T
    return table[:, :3], None


def _named_columns(table: NDArray[Any]) -> tuple[Points, Times | None]:
    """Return points and times of an array with named fields."""
    names = {name.lower(): name for name in table.dtype.names or ()}
    missing = [axis for axis in "xyz" if axis not in names or table.dtype[names[axis]].kind not in "fiu"]
    if missing:
        raise ValueError(f"it has no field {missing[0]} of numbers among {', '.join(names)[:100]}")
    time = time_field({name: table.dtype[name].str for name in names.values()})
    points = np.column_stack([table[names[axis]] for axis in "xyz"])
    return points, None if time is None else table[time]


def _has_faces(path: Path) -> bool:
    return path.suffix.lower() == ".ply" and read_ply_header(path)[1].get(b"face", 0) > 0


_READERS: dict[str, Callable[[Path], tuple[NDArray[Any], Times | None]]] = {
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".npy": _read_npy,
    **dict.fromkeys(TEXT_SUFFIXES, read_text),
}
