"""Points from the files of maps: PCD, PLY, LAS, LAZ, NPY, and text formats.

PCD and LAS are read here: both are small formats, and the libraries that read them are large or need system libraries
that a bare machine lacks. LAZ and text are left to such libraries, which come with the extra `maps`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError

__all__ = ["MAP_SUFFIXES", "read_mesh", "read_points"]

Points = NDArray[np.float64]


def read_points(path: str | Path) -> Points:
    """Return the positions in a file of points [m], float64 [n, 3]; rows that are not finite are left out.

    PCD ascii, binary and binary_compressed; PLY ascii and binary; LAS 1.0 to 1.4; NPY with rows x, y, z, ...; LAZ where
    laspy with a LAZ backend is installed; XYZ, XYZN, XYZRGB and PTS where open3d is.

    Raises:
        UserError: the file cannot be read, is of another form, or holds no points.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path} is no map: its name must end in one of {', '.join(MAP_SUFFIXES)}.")
    try:
        points = np.asarray(reader(path), dtype=np.float64)
    except OSError as error:
        raise UserError(f"Cannot read the map {path}: {error.strerror or error}.") from error
    except (ValueError, IndexError, KeyError, TypeError, struct.error) as error:
        raise UserError(f"{path} is no map that can be read: {str(error).rstrip('.')}.") from error
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise UserError(f"{path} holds no finite points; give a map with at least one.")
    return points


def read_mesh(path: str | Path) -> Points:
    """Return the triangles of a mesh [m], float64 [n, 9]; none for a file of points.

    OBJ, STL, GLB, OFF, and PLY that has faces; in metres, z up.

    Raises:
        UserError: the file cannot be read, is of another form, or ought to be a mesh and is none.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*_MESHES, ".ply"):
        return np.zeros((0, 9))
    from aero_viz.scenes.triangles import read_triangles

    try:
        head = path.read_bytes()[:4096]
        if suffix == ".ply" and not re.search(rb"\nelement face [1-9]", head):
            return np.zeros((0, 9))
        triangles = read_triangles(path)
    except OSError as error:
        raise UserError(f"Cannot read the mesh {path}: {error.strerror or error}.") from error
    except ValueError as error:
        raise UserError(f"{path} is no mesh that can be read: {' '.join(str(error).split())}.") from error
    if not len(triangles):
        raise UserError(f"{path} holds no triangles; give a mesh with at least one.")
    return triangles


def _read_npy(path: Path) -> Points:
    table = np.load(path, allow_pickle=False)
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise ValueError("it must hold one array of numbers with rows x, y, z, ..")
    return table[:, :3]


def _read_ply(path: Path) -> Points:
    import trimesh

    if path.read_bytes()[:3] != b"ply":
        raise ValueError("it does not start with ply")
    try:
        loaded: Any = trimesh.load(path, process=False)
    except Exception as error:  # trimesh raises what its parser happens to meet
        raise ValueError(f"its header or data are damaged ({type(error).__name__}: {error})") from error
    vertices = getattr(loaded, "vertices", None)
    if vertices is None or len(vertices) == 0:
        raise ValueError("it has no vertices")
    return np.array(vertices)


def _read_las(path: Path) -> Points:
    raw = path.read_bytes()
    if raw[:4] != b"LASF":
        raise ValueError("it does not start with LASF")
    start, kind, length, count = struct.unpack_from("<IBHI", raw, 96)
    if kind & 0xC0:  # LAZ marks its records in the highest bits
        return _read_laz(path)
    if raw[25] >= 4:
        count = struct.unpack_from("<Q", raw, 247)[0]
    scale, offset = np.frombuffer(raw, "<f8", 6, 131).reshape(2, 3)
    if len(raw) < start + count * length:
        raise ValueError(f"it is cut off: its header says {count} points")
    # All point formats begin with x, y, z as scaled integers.
    records = np.frombuffer(raw, np.uint8, count * length, start).reshape(count, length)
    return np.ascontiguousarray(records[:, :12]).view("<i4") * scale + offset


def _read_laz(path: Path) -> Points:
    try:
        import laspy  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UserError(
            f"{path} is compressed: install a reader with `pip install 'aero-viz[maps]'`, or convert the file to LAS."
        ) from None
    try:
        return np.array(laspy.read(path).xyz)
    except laspy.errors.LaspyException as error:
        raise ValueError(f"laspy cannot read it: {error}") from error


def _read_text(path: Path) -> Points:
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:  # OSError: a system library is missing
        raise UserError(
            f"{path} needs open3d, which does not load ({str(error).splitlines()[0]}): install it with "
            "`pip install 'aero-viz[maps]'` (see aero-viz doctor), or convert the file to PCD or PLY."
        ) from None
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        return np.asarray(open3d.io.read_point_cloud(path).points)


def _read_pcd(path: Path) -> Points:
    raw = path.read_bytes()
    found = re.search(rb"(?:^|\n)DATA[ \t]+(\w+)[ \t]*\r?\n", raw[:4096])
    if not found:
        raise ValueError("it has no PCD header that ends in a line DATA")
    header = {}
    for line in raw[: found.start()].decode("ascii", "replace").splitlines():
        key, *values = line.split("#")[0].split() or [""]
        header[key] = values
    fields, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = [int(n) for n in header.get("COUNT", ["1"] * len(fields))]
    count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    for axis in "xyz":
        if axis not in fields:
            raise ValueError(f"it has no field {axis} among {', '.join(fields)}")
    kinds = [f"<{'f' if t == 'F' else t.lower()}{size}" for t, size in zip(types, sizes, strict=True)]
    body, data = raw[found.end() :], found.group(1).decode()
    if count == 0:
        return np.zeros((0, 3))
    if data == "ascii":
        columns = [sum(counts[: fields.index(axis)]) for axis in "xyz"]
        return np.loadtxt(body.decode("ascii", "replace").splitlines(), usecols=columns, max_rows=count, ndmin=2)
    # Names may repeat, such as the padding "_"; positions do not.
    names = [f"f{i}" for i in range(len(fields))]
    wanted = [names[fields.index(axis)] for axis in "xyz"]
    record = np.dtype([(name, kind, (n,)) for name, kind, n in zip(names, kinds, counts, strict=True)])
    if data == "binary":
        table: NDArray[Any] = np.frombuffer(body, record, count)
        return np.column_stack([table[name][:, 0] for name in wanted])
    if data == "binary_compressed":
        packed, size = struct.unpack_from("<II", body)
        plain = _decompress_lzf(body[8 : 8 + packed], size)
        # Field by field, not point by point.
        starts = np.cumsum([0, *(record[name].itemsize * count for name in names)])
        axes = []
        for name in wanted:
            kind, shape = record[name].subdtype or (record[name], (1,))
            axes.append(np.frombuffer(plain, kind, count * shape[0], int(starts[names.index(name)]))[:: shape[0]])
        return np.column_stack(axes)
    raise ValueError(f"its data are {data}; it must be ascii, binary or binary_compressed")


def _decompress_lzf(packed: bytes, size: int) -> bytes:
    """Undo LZF (Lehmann): runs of literal bytes, and copies of what came before, which may overlap themselves."""
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
        back = ((control & 31) << 8) + packed[i] + 1
        i += 1
        start = len(plain) - back
        if start < 0:
            raise ValueError("its compressed data are damaged")
        copied = plain[start : start + length]
        plain += (copied * (length // len(copied) + 1))[:length] if len(copied) < length else copied
    if len(plain) != size:
        raise ValueError(f"its compressed data hold {len(plain)} bytes; the header says {size}")
    return bytes(plain)


_READERS: dict[str, Callable[[Path], Points]] = {
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".las": _read_las,
    ".laz": _read_las,
    ".npy": _read_npy,
    ".xyz": _read_text,
    ".xyzn": _read_text,
    ".xyzrgb": _read_text,
    ".pts": _read_text,
}
_MESHES = (".obj", ".stl", ".glb", ".off")
MAP_SUFFIXES = (*_READERS, *_MESHES)
"""Endings of the names of the files that `read_points` and `read_mesh` read."""
