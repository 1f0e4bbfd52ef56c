"""Points and triangles from files, decoded by open3d (PLY, texts), laspy (LAS, LAZ), trimesh (meshes) and NumPy.

The libraries are imported on first use, since open3d alone takes 0.6 s. open3d trusts the counts in a header: it
allocates what they declare and fills the missing points of a truncated file with arbitrary values, so that counts are
compared with the content first. PCD is decoded with NumPy: of the two readers of open3d 0.20, one reads double
coordinates as zeros, and the other crashes on some compressed files.
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

_HEADER_MAX = 65_536  # [bytes] of a PCD or PLY file that are searched for the end of the header
_LAS_CHUNK = 1_000_000  # points decoded at once
_LAS_HEADER_MAX = 375  # [bytes]
_LZF_RATIO_MAX = 88  # a copy of 3 bytes yields at most 264
_PLY_SIZES = {"char": 1, "short": 2, "int": 4, "float": 4, "double": 8} | {"int8": 1, "int16": 2, "int32": 4}
_PLY_SIZES |= {f"u{name}": size for name, size in _PLY_SIZES.items()} | {"float32": 4, "float64": 8}


def read_points(path: str | Path) -> Points:
    """Return the points of a file [m], float64 [n, 3], without rows that are not finite.

    Formats: PCD (ascii, binary, binary_compressed), PLY, LAS, LAZ, NPY with rows x, y, z, .., and XYZ, XYZN, XYZRGB and
    PTS texts.

    Raises:
        UserError: the file cannot be read, is damaged or truncated, or holds no points.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path} is not a map: its name must end in one of {', '.join(MAP_SUFFIXES)}.")
    points = _read(path, "map", reader).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise UserError(f"{path} holds no finite points; give a map with at least one.")
    return points


def read_mesh(path: str | Path) -> Points:
    """Return the triangles of a mesh [m], float64 [n, 9], without degenerate ones; empty for a file of points.

    Formats: OBJ, STL, GLB, OFF, and PLY with faces; in metres, z up.

    Raises:
        UserError: the file cannot be read, is damaged, or holds no triangles although its format is one of meshes.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _MESHES and not (suffix == ".ply" and _read(path, "mesh", _has_faces)):
        return np.zeros((0, 9))
    triangles = _read(path, "mesh", _read_triangles)
    if not len(triangles):
        raise UserError(f"{path} holds no triangles; give a mesh with at least one.")
    return triangles


def _read(path: Path, kind: str, reader: Callable[[Path], Any]) -> Any:
    """Return the result of `reader` for a file; errors become a UserError of one sentence."""
    if path.exists() and not path.is_file():
        raise UserError(f"Cannot read the {kind} {path}: it is not a regular file.")
    try:
        return reader(path)
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"Cannot read the {kind} {path}: {error.strerror or error}.") from error
    except Exception as error:  # the parsers raise whatever a damaged file leads them to
        reason = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise UserError(f"Cannot read the {kind} {path}: {reason}.") from error


def _read_triangles(path: Path) -> Points:
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        corners = np.asarray(mesh.triangles, dtype=np.float64)
    except OSError:
        raise
    except Exception as error:
        raise ValueError(f"its data are damaged ({type(error).__name__}: {error})") from error
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[area > 0.0].reshape(-1, 9)


def _read_npy(path: Path) -> Points:
    # A memory map refuses a file that is shorter than its header declares, and allocates nothing.
    table = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise ValueError("it must hold one array of numbers with rows x, y, z, ..")
    return np.array(table[:, :3], dtype=np.float64)


def _read_las(path: Path) -> Points:
    import laspy

    with path.open("rb") as file:
        header = file.read(_LAS_HEADER_MAX).ljust(_LAS_HEADER_MAX, b"\0")
    if header[:4] != b"LASF":
        raise ValueError("it does not start with LASF")
    size = path.stat().st_size
    first_point, records = struct.unpack_from("<II", header, 96)
    extended_records = struct.unpack_from("<I", header, 243)[0] if header[25] >= 4 else 0
    # laspy would read billions of empty variable-length records beyond the end of the file.
    if first_point > size or 54 * records > first_point or 60 * extended_records > size:
        raise ValueError("its header is damaged: it declares more records than the file holds")
    if header[104] & 0x80:
        _check_laz_chunks(path, first_point, size)
    with laspy.open(path) as reader:
        declared = reader.header.point_count
        chunks = [np.array([c.x, c.y, c.z], dtype=np.float64).T for c in reader.chunk_iterator(_LAS_CHUNK)]
    points = np.vstack(chunks) if chunks else np.zeros((0, 3))
    _check_count(declared, len(points))
    return points


def _check_laz_chunks(path: Path, first_point: int, size: int) -> None:
    """Refuse a chunk table that does not fit into a LAZ file: lazrs aborts the process if it cannot allocate it."""
    with path.open("rb") as file:
        file.seek(first_point)
        table = struct.unpack("<q", file.read(8))[0]
        if table == -1:  # written at the end by a writer that could not seek
            file.seek(-8, 2)
            table = struct.unpack("<q", file.read(8))[0]
        if not 0 < table <= size - 8:
            raise ValueError("its compressed data are truncated or damaged")
        file.seek(table + 4)
        if struct.unpack("<I", file.read(4))[0] > size:
            raise ValueError("its compressed data are damaged")


def _read_text(path: Path) -> Points:
    if path.suffix.lower() == ".pts":
        first, *lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
        _check_count(int(first), sum(1 for line in lines if line.strip()))
    return _read_with_open3d(path)


def _read_ply(path: Path) -> Points:
    header, size = _header(path, rb"(?s)^ply\s.*?\nend_header[ \t]*\r?\n", "it does not start with a PLY header")
    declared = re.findall(rb"\nelement[ \t]+(\w+)[ \t]+(\d+)", header)
    vertices = next((int(count) for name, count in declared if name == b"vertex"), 0)
    if not vertices:
        raise ValueError("it has no vertices")
    properties = re.findall(
        rb"\nproperty[ \t]+(\w+)", re.split(rb"\nelement[ \t]+vertex", header)[1].split(b"\nelement")[0]
    )
    if b"format ascii" in header:
        values = len(path.read_bytes()[len(header) :].split())
        _check_count(vertices, values // max(len(properties), 1))
    else:
        # A list holds at least its length; elements before the vertices only add to what the file must hold.
        record = sum(_PLY_SIZES.get(name.decode(), 1) for name in properties)
        _check_count(vertices, size // max(record, 1))
    return _read_with_open3d(path)


def _read_pcd(path: Path) -> Points:
    header, size = _header(path, rb"(?s)^.*?(?:^|\n)DATA[ \t]+\w+[ \t]*\r?\n", "it has no PCD header that ends in DATA")
    rows = [line.split("#")[0].split() for line in header.decode("ascii", "replace").splitlines()]
    entries = {row[0]: row[1:] for row in rows if row}
    fields, sizes, types, data = entries["FIELDS"], entries["SIZE"], entries["TYPE"], entries["DATA"][0]
    counts = [int(n) for n in entries.get("COUNT", ["1"] * len(fields))]
    points = int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
    for axis in "xyz":
        if axis not in fields:
            raise ValueError(f"it has no field {axis} among {', '.join(fields)}")
    axes = [fields.index(axis) for axis in "xyz"]
    if points == 0:
        return np.zeros((0, 3))
    if data == "ascii":
        columns = [sum(counts[:i]) for i in axes]
        table: NDArray[Any] = np.loadtxt(path, skiprows=header.count(b"\n"), usecols=columns, max_rows=points, ndmin=2)
        _check_count(points, len(table))
        return table
    # Names may repeat, such as the padding "_"; positions do not.
    names = [f"f{i}" for i in range(len(fields))]
    kinds = [f"<{'f' if t == 'F' else t.lower()}{n}" for t, n in zip(types, sizes, strict=True)]
    record = np.dtype([(name, kind, (n,)) for name, kind, n in zip(names, kinds, counts, strict=True)])
    content = path.read_bytes()[len(header) :]
    if data == "binary":
        _check_count(points, size // record.itemsize)
        table = np.frombuffer(content, record, points)
        return np.column_stack([table[names[i]][:, 0] for i in axes])
    if data != "binary_compressed":
        raise ValueError(f"its data are {data}; they must be ascii, binary or binary_compressed")
    packed_size, plain_size = struct.unpack_from("<II", content)
    if plain_size != points * record.itemsize or packed_size > size - 8 or plain_size > _LZF_RATIO_MAX * packed_size:
        raise ValueError("its compressed data do not have the size that its header declares")
    plain = _decompress_lzf(content[8 : 8 + packed_size], plain_size)
    # Compressed data are stored field by field, not point by point.
    columns = []
    for i in axes:
        first = points * sum(record[name].itemsize for name in names[:i])
        columns.append(np.frombuffer(plain, kinds[i], points * counts[i], first)[:: counts[i]])
    return np.column_stack(columns)


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


def _header(path: Path, pattern: bytes, problem: str) -> tuple[bytes, int]:
    """Return the header of a file and the number of bytes after it."""
    with path.open("rb") as file:
        found = re.match(pattern, file.read(_HEADER_MAX))
    if found is None:
        raise ValueError(problem)
    return found.group(), path.stat().st_size - found.end()


def _has_faces(path: Path) -> bool:
    with path.open("rb") as file:
        return re.search(rb"\nelement face [1-9]", file.read(4096)) is not None


def _check_count(declared: int, present: int) -> None:
    if present < declared:
        raise ValueError(f"it is truncated: its header declares {declared} points, and it holds {present}")


def _read_with_open3d(path: Path) -> Points:
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: a system library is missing
        reason = str(error).splitlines()[0]
        raise ValueError(f"open3d does not load ({reason}); run aero-viz doctor, or convert the file to PCD") from error
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        return np.asarray(open3d.io.read_point_cloud(path).points, dtype=np.float64)


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
"""File name suffixes that `read_points` and `read_mesh` read."""
