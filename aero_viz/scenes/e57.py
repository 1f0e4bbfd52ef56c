"""Points of E57 files, decoded by pye57.

It trusts the counts in a header, and opens the files and addresses that the XML part names, so both are checked first.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import rotate
from aero_planner.user_file import open_user_file
from aero_viz.extras import from_extra
from aero_viz.scenes.decoder_checks import check_count, refuse_entities

_BITS_MIN = 8
"""Least size of a point that scanners write [bits]; a coordinate alone has more."""
_PAGE, _CHECKSUM = 1024, 4
"""Length of a page of the file, and of the checksum at its end [bytes]."""
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_UNIT_ERROR_MAX = 0.1
"""Largest error of the length of a quaternion."""
_PROLOG_MAX = 65_536
"""Bytes of the XML part in which its first element must begin."""


def read_e57(path: Path) -> tuple[NDArray[np.float64], None]:
    """Return the valid points of all scans of an E57 file [n, 3] [m], in the frame that the scans have in common.

    Raises:
        Exception: the file is damaged or truncated; a ValueError has a text for the user.
    """
    with from_extra("formats", f"{path} and other E57 files"):
        import pye57
    with open_user_file(path) as file:
        _check_xml(file)
        with pye57.E57(_name_of(file.fileno(), path)) as scans:
            headers = [scans.get_header(index) for index in range(scans.scan_count)]
            check_count(sum(header.point_count for header in headers), path.stat().st_size * 8 // _BITS_MIN)
            return np.concatenate([np.zeros((0, 3)), *(_read_scan(scans, header) for header in headers)]), None


def _read_scan(scans: Any, header: Any) -> NDArray[np.float64]:
    """Return the valid points of a scan [n, 3] [m], in the frame that the scans have in common.

    pye57's own `read_scan` returns whatever is in memory where a file holds fewer points than its header declares, and
    takes the parts of a rotation in the order of the file.
    """
    from pye57.utils import convert_spherical_to_cartesian

    axes = next((axes for axes in (_CARTESIAN, _SPHERICAL) if {*axes} <= {*header.point_fields}), None)
    if axes is None:
        raise ValueError(f"a scan has no coordinates, only {', '.join(header.point_fields)[:100] or 'nothing'}")
    state = "cartesianInvalidState" if axes is _CARTESIAN else "sphericalInvalidState"
    names = [name for name in (*axes, state) if name in header.point_fields]
    columns, buffers = scans.make_buffers(names, header.point_count)
    check_count(header.point_count, header.points.reader(buffers).read())
    points = np.column_stack([columns[name] for name in axes])
    points = points if axes is _CARTESIAN else convert_spherical_to_cartesian(points)
    if state in columns:
        points = points[columns[state] == 0]
    rotation = _numbers(header.node, "pose/rotation", "wxyz", [1.0, 0.0, 0.0, 0.0])
    length = np.linalg.norm(rotation)
    if not abs(length - 1.0) < _UNIT_ERROR_MAX:
        raise ValueError(f"the rotation of a scan is a quaternion of the length {length:.3g}")
    return rotate(rotation / length, points) + _numbers(header.node, "pose/translation", "xyz", [0.0, 0.0, 0.0])


def _numbers(node: Any, path: str, names: str, default: list[float]) -> NDArray[np.float64]:
    """Return the numbers of a structure below a node, or the default where there is none."""
    return np.array([node[f"{path}/{name}"].value() for name in names] if node.isDefined(path) else default)


def _check_xml(file: BinaryIO) -> None:
    """Raise ValueError unless the XML part of a file begins with an element, before which it defines nothing."""
    header = file.read(48)
    if len(header) < 48 or not header.startswith(b"ASTM-E57"):
        raise ValueError("it does not start with ASTM-E57")
    begin, length = struct.unpack_from("<QQ", header, 24)
    if begin + length > file.seek(0, 2):
        raise ValueError("it is truncated: its part of XML lies beyond its end")
    file.seek(begin - begin % _PAGE)
    pages = [file.read(_PAGE)[:-_CHECKSUM] for _ in range(_PROLOG_MAX // _PAGE)]
    prolog = b"".join(pages)[begin % _PAGE :][:length]
    elements: list[str] = []
    parser = expat.ParserCreate()
    refuse_entities(parser)
    parser.StartElementHandler = lambda name, _: elements.append(name)
    try:
        parser.Parse(prolog, False)
    except expat.ExpatError as error:
        raise ValueError(f"its part of XML is damaged: {expat.ErrorString(error.code)}") from error
    if not elements:
        raise ValueError(f"its part of XML begins with no element within {_PROLOG_MAX >> 10} KiB")


def _name_of(descriptor: int, path: Path) -> str:
    """Return a name that an open file keeps if another file takes its place; its path where there is no such name."""
    name = Path(f"/proc/self/fd/{descriptor}")
    return str(name if name.exists() else path)
