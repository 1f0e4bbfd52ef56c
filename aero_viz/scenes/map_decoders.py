"""Points from files, decoded by open3d (PLY), laspy (LAS, LAZ) and NumPy; triangles by `mesh_decoder`.

Run it in a process of its own, see `decoding_process`. The libraries are imported on first use, since open3d alone
takes 0.6 s. They trust the counts in a header, so that counts are compared with the size of the file before anything
is allocated, and with what was read.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_viz.input_limits import MAP_POINTS_MAX
from aero_viz.scenes.decoder_checks import check_count, read_ply_header
from aero_viz.scenes.las import read_las
from aero_viz.scenes.mesh_decoder import read_triangles
from aero_viz.scenes.pcd import read_pcd

Points = NDArray[np.float64]

_PLY_SIZES = {"char": 1, "short": 2, "int": 4, "float": 4, "double": 8} | {"int8": 1, "int16": 2, "int32": 4}
_PLY_SIZES |= {f"u{name}": size for name, size in _PLY_SIZES.items()} | {"float32": 4, "float64": 8}


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
    points = reader(path).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]


def _read_npy(path: Path) -> Points:
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, is_fortran, dtype = read(file)
        if len(shape) == 3 and not is_fortran:  # an organised cloud
            shape = (shape[0] * shape[1], shape[2])
        if len(shape) != 2 or shape[1] < 3 or dtype.kind not in "fiu":
            raise ValueError("it must hold one array of numbers with columns x, y, z")
        here = file.tell()
        check_count(shape[0], (file.seek(0, 2) - here) // (shape[1] * dtype.itemsize))
        file.seek(here)
        table = np.fromfile(file, dtype, shape[0] * shape[1])
    table = table.reshape(shape[::-1]).T if is_fortran else table.reshape(shape)
    return table[:, :3].astype(np.float64)


def _read_text(path: Path) -> Points:
    declared, skipped, rows = None, 0, path.stat().st_size // len("0 0 0\n") + 1
    if path.suffix.lower() == ".pts":
        with path.open("rb") as file:
            declared, skipped = int(file.readline(32)), 1
    points = np.loadtxt(
        path, skiprows=skipped, usecols=(0, 1, 2), ndmin=2, comments=("#", "//"), encoding="utf-8",
        max_rows=min(rows, MAP_POINTS_MAX) + 1,  # NumPy reserves the memory for so many
    )  # fmt: skip
    check_count(len(points) if declared is None else declared, len(points))
    _check_last_line(path)
    return points


def _check_last_line(path: Path) -> None:
    """Refuse a table of numbers whose last row has fewer columns than the one before."""
    with path.open("rb") as file:
        file.seek(max(file.seek(0, 2) - 4096, 0))
        rows = [line.split() for line in file.read().splitlines()[1:] if line.strip()]
    if len(rows) > 1 and len(rows[-1]) < len(rows[-2]):
        raise ValueError(f"it is truncated: its last row has {len(rows[-1])} columns, and others have {len(rows[-2])}")


def _read_ply(path: Path) -> Points:
    header, counts = read_ply_header(path)
    vertices, size = counts.get(b"vertex", 0), path.stat().st_size - len(header)
    if not vertices:
        raise ValueError("it has no vertices")
    properties = re.findall(
        rb"\nproperty[ \t]+(\w+)", re.split(rb"\nelement[ \t]+vertex", header)[1].split(b"\nelement")[0]
    )
    # A list holds at least its length; other elements only add to what the file must hold.
    record = sum(_PLY_SIZES.get(name.decode(), 1) for name in properties)
    if b"format ascii" in header:
        record = 2 * len(properties)  # a digit and a space
        check_count(vertices, (size + 1) // max(record, 1))
        values = len(path.read_bytes()[len(header) :].split())
        check_count(vertices, values // max(len(properties), 1))
    else:
        check_count(vertices, size // max(record, 1))
    points = _read_with_open3d(path)
    check_count(vertices, len(points))
    return points


def _has_faces(path: Path) -> bool:
    return path.suffix.lower() == ".ply" and read_ply_header(path)[1].get(b"face", 0) > 0


def _read_with_open3d(path: Path) -> Points:
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: a system library is missing
        reason = str(error).splitlines()[0]
        raise ValueError(f"open3d does not load ({reason}); run aero-viz doctor, or convert the file to PCD") from error
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        return np.asarray(open3d.io.read_point_cloud(path).points, dtype=np.float64)


_READERS: dict[str, Callable[[Path], Points]] = {
    ".pcd": read_pcd,
    ".ply": _read_ply,
    ".las": read_las,
    ".laz": read_las,
    ".npy": _read_npy,
    ".xyz": _read_text,
    ".xyzn": _read_text,
    ".xyzrgb": _read_text,
    ".pts": _read_text,
}
