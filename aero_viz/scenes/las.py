"""Points of LAS and LAZ files, decoded by laspy. It trusts their headers, so these are checked first."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.extras import from_extra
from aero_viz.point_times import time_field
from aero_viz.scenes.decoder_checks import check_count
from aero_viz.scenes.epsg_units import FOOT, US_FOOT, unit_of_heights, unit_of_system

_CHUNK = 1_000_000  # points decoded at once
_HEADER_MIN, _HEADER_MAX = 227, 375  # [bytes]
_LENGTHS = {9001: 1.0, 9002: FOOT, 9003: US_FOOT}
"""GeoTIFF codes of linear units [m]."""
_HORIZONTAL_KEY, _VERTICAL_KEY = 3076, 4099
"""ProjLinearUnitsGeoKey and VerticalUnitsGeoKey."""
_SYSTEM_KEY, _VERTICAL_SYSTEM_KEY = 3072, 4096
"""ProjectedCSTypeGeoKey and VerticalCSTypeGeoKey: codes of EPSG."""
_MODEL_KEY, _PROJECTED = 1024, 1
"""GTModelTypeGeoKey, and its value for coordinates that are lengths in a plane."""
_GEO_KEYS, _GEO_TEXTS, _WKT = 34735, 34737, 2112
_WKT_UNIT = re.compile(
    r'UNIT\s*\[\s*"([^"]*)"\s*,\s*([0-9.eE+-]{1,40})'
    r'(?:\s*,\s*(?:AUTHORITY|ID)\s*\[\s*"EPSG"\s*,\s*"?(\d{4,6}))?',
    re.IGNORECASE,
)
"""A unit in a text: its name, factor and EPSG code."""
_NO_LENGTH = re.compile("degree|radian|grad|unity|second", re.IGNORECASE)
_NAMED_LENGTHS = (
    (r"(us|ussurvey|survey)(foot|feet|ft)|(foot|feet|ft)(us|ussurvey|survey)", US_FOOT),
    (r"(intl?|international)?(foot|feet|ft)(intl?|international)?", FOOT),
    (r"(metre|meter)s?|m", 1.0),
)
"""Patterns of names of units, letters only, and their lengths [m]."""
_TOLERANCE = 1e-3
"""Relative difference from which a factor contradicts its name."""
_NOISE = (7, 18)
"""Classes of low and high noise."""


class LasUnits(NamedTuple):
    """Lengths of the units of a LAS or LAZ file [m], 1 where it does not say."""

    horizontal: float = 1.0
    vertical: float = 1.0
    is_named: bool = True
    """False if the file names no coordinate system."""
    notice: str = ""
    """Sentence on what is odd about the units; empty if nothing is."""


def read_las(path: Path) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """Return the points of a LAS or LAZ file [n, 3] [m], and their times [n] as stored, or None.

    Points that are withheld or classified as noise are left out. Coordinates in feet are converted.

    Raises:
        Exception: the file is damaged or truncated; a ValueError has a text for the user.
    """
    with from_extra("formats", f"{path} and other LAS files"):
        import laspy
    _check_header(path)
    with laspy.open(open_user_file(path)) as reader:
        declared, units, present = reader.header.point_count, _units(reader.header), 0
        time = time_field({row.name: row.type_str() or "" for row in reader.header.point_format})
        parts, times = [np.zeros((0, 3))], []
        for chunk in reader.chunk_iterator(_CHUNK):
            present += len(chunk)
            kept = np.flatnonzero(
                ~(np.asarray(chunk.withheld, np.bool_) | np.isin(np.array(chunk.classification), _NOISE))
            )
            used: Any = chunk if len(kept) == len(chunk) else chunk[kept]
            parts.append(np.column_stack([used.x, used.y, used.z]))
            times += [] if time is None else [np.asarray(used[time])]
    check_count(declared, present)
    points = np.concatenate(parts)
    points *= (units.horizontal, units.horizontal, units.vertical)
    return points, np.concatenate(times) if times else None


def read_las_units(path: Path) -> LasUnits:
    """Return the units of a LAS or LAZ file.

    Raises:
        Exception: as for `read_las`.
    """
    with from_extra("formats", f"{path} and other LAS files"):
        import laspy
    _check_header(path)
    with laspy.open(open_user_file(path)) as reader:
        return _units(reader.header)


def _check_header(path: Path) -> None:
    """Raise ValueError if the counts and offsets of a header do not fit the file."""
    with open_user_file(path) as file:
        header = file.read(_HEADER_MAX).ljust(_HEADER_MAX, b"\0")
        size = file.seek(0, 2)
    if header[:4] != b"LASF":
        raise ValueError("it does not start with LASF")
    if size < _HEADER_MIN:
        raise ValueError(f"it is truncated: its header has {size} bytes of at least {_HEADER_MIN}")
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
    with open_user_file(path) as file:
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


def _units(header: Any) -> LasUnits:
    keys, texts, units = {}, "", None
    for record in [*header.vlrs, *(header.evlrs or ())]:
        if record.record_id == _GEO_KEYS:  # rows of key, location, count, value
            content = record.record_data_bytes()[8:]
            rows = np.frombuffer(content[: len(content) // 8 * 8], "<u2").reshape(-1, 4)
            keys = {key: value for key, location, _, value in rows.tolist() if location == 0}
        elif record.record_id == _GEO_TEXTS:
            texts = record.record_data_bytes().decode(errors="replace").lower()
        elif record.record_id == _WKT:
            text = record.record_data_bytes().decode(errors="replace")
            if re.search(r"GEO(G|D|C)(CS|CRS)", text, re.I) and not re.search(r"PROJ(CS|CRS)|PROJECTEDCRS", text, re.I):
                _check_no_degrees(header)
            units = _units_of_wkt(text)
    if units is not None:
        return units
    if keys.get(_MODEL_KEY, _PROJECTED) != _PROJECTED:
        _check_no_degrees(header)
    by_text = US_FOOT if any(name in texts for name in ("ftus", "us survey f", "foot_us")) else None
    by_height = _LENGTHS.get(keys.get(_VERTICAL_KEY, 0))
    horizontal = _LENGTHS.get(keys.get(_HORIZONTAL_KEY, 0)) or unit_of_system(keys.get(_SYSTEM_KEY, 0)) or by_text
    if horizontal is None and _SYSTEM_KEY not in keys and not texts:
        horizontal = by_height
    vertical = by_height or unit_of_heights(keys.get(_VERTICAL_SYSTEM_KEY, 0))
    if vertical is None:  # a vertical system that is in no feet is in metres
        vertical = 1.0 if _VERTICAL_SYSTEM_KEY in keys else horizontal
    return LasUnits(horizontal or 1.0, vertical or 1.0, bool(keys or texts))


def _check_no_degrees(header: Any) -> None:
    """Refuse coordinates that are longitudes and latitudes, which say nothing about distances."""
    if np.abs([*header.mins[:2], *header.maxs[:2]]).max() <= 360.0:
        raise ValueError(
            "its coordinates are degrees: convert it to metres, for example with "
            "`pdal translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:326NN`, NN being the UTM zone"
        )


def _units_of_wkt(text: str) -> LasUnits:
    """Return the last unit of length of the horizontal and of the vertical coordinate system."""
    parts = re.split(r"VERT_?(?:CS|CRS)\b", text, maxsplit=1, flags=re.IGNORECASE)
    found: list[tuple[float, str]] = []
    for part in parts:
        lengths = [match for match in _WKT_UNIT.finditer(part) if not _NO_LENGTH.search(match[1])]
        found.append(_length(lengths[-1]) if lengths else (1.0, ""))
    notices = dict.fromkeys(notice for _, notice in found if notice)
    units = LasUnits(found[0][0], found[-1][0], notice="; ".join(notices))
    if not all(0.01 < unit < 100.0 for unit in (units.horizontal, units.vertical)):
        raise ValueError("the units in its coordinate system are damaged")
    return units


def _length(unit: re.Match[str]) -> tuple[float, str]:
    """Return the length of a unit [m], and a notice where its name and its factor contradict each other."""
    name, factor, code = unit[1], float(unit[2]), int(unit[3] or 0)
    plain = re.sub(r"[^a-z]", "", name.lower())
    known = next((length for pattern, length in _NAMED_LENGTHS if re.fullmatch(pattern, plain)), factor)
    if abs(factor - known) <= _TOLERANCE * known:
        return factor, ""
    length = _LENGTHS.get(code, known)
    shown = "".join(letter if letter.isprintable() else "?" for letter in name)[:40]
    return length, f"a unit of the file is called {shown!r} and is {factor:g} m long: {length:.7g} m are used"
