"""Points of LAS and LAZ files, decoded by laspy. Its trust in headers is why they are checked first."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.decoder_checks import check_count

__all__ = ["read_las", "read_las_unit"]

_CHUNK = 1_000_000  # points decoded at once
_HEADER_MAX = 375  # [bytes]
_FEET = {9002: 0.3048, 9003: 1200 / 3937}
"""GeoTIFF codes of linear units: the international foot and the US survey foot [m]."""
_UNIT_KEYS = (3076, 4099)  # ProjLinearUnitsGeoKey, VerticalUnitsGeoKey
_GEO_KEYS, _WKT = 34735, 2112


def read_las(path: Path) -> NDArray[np.float64]:
    """Return the points of a LAS or LAZ file [n, 3] [m]; coordinates in feet are converted.

    Raises:
        Exception: the file is damaged or truncated; a ValueError has a text for the user.
    """
    import laspy

    _check_header(path)
    with laspy.open(path) as reader:
        declared, unit = reader.header.point_count, _unit(reader.header)
        chunks = [np.array([c.x, c.y, c.z], dtype=np.float64).T for c in reader.chunk_iterator(_CHUNK)]
    points = np.vstack(chunks) if chunks else np.zeros((0, 3))
    check_count(declared, len(points))
    return points * unit


def read_las_unit(path: Path) -> float:
    """Return the length of the unit of a LAS or LAZ file [m], 1 where the file does not say.

    Raises:
        Exception: as for `read_las`.
    """
    import laspy

    _check_header(path)
    with laspy.open(path) as reader:
        return _unit(reader.header)


def _check_header(path: Path) -> None:
    """Raise ValueError if the counts and offsets of a header do not fit the file."""
    with path.open("rb") as file:
        header = file.read(_HEADER_MAX).ljust(_HEADER_MAX, b"\0")
    if header[:4] != b"LASF":
        raise ValueError("it does not start with LASF")
    size = path.stat().st_size
    first_point, records = struct.unpack_from("<II", header, 96)
    extended_records = struct.unpack_from("<I", header, 243)[0] if header[25] >= 4 else 0
    # laspy would read billions of empty variable-length records beyond the end of the file.
    if first_point > size or 54 * records > first_point or 60 * extended_records > size:
        raise ValueError("its header is damaged: it declares more records than the file holds")
    declared = struct.unpack_from("<Q", header, 247)[0] if header[25] >= 4 else struct.unpack_from("<I", header, 107)[0]
    record = struct.unpack_from("<H", header, 105)[0]
    check_count(declared, declared if header[104] & 0x80 else (size - first_point) // max(record, 1))
    if header[104] & 0x80:
        _check_laz_chunks(path, first_point, size)


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


def _unit(header: Any) -> float:
    for record in header.vlrs:
        if record.record_id == _GEO_KEYS:  # rows of key, location, count, value
            content = record.record_data_bytes()[8:]
            rows = np.frombuffer(content[: len(content) // 8 * 8], "<u2").reshape(-1, 4)
            for key, location, _, value in rows.tolist():
                if key in _UNIT_KEYS and location == 0 and value in _FEET:
                    return _FEET[value]
        elif record.record_id == _WKT:
            text = record.record_data_bytes().decode(errors="replace").lower()
            if "us survey foot" in text or "foot_us" in text:
                return _FEET[9003]
            if '"foot"' in text or "international foot" in text:
                return _FEET[9002]
    return 1.0
