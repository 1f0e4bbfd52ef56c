"""Points of E57 files, decoded by pye57. It trusts the counts in a header, so these are checked first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.extras import from_extra
from aero_viz.scenes.decoder_checks import check_count

_BITS_MIN = 8
"""Least size of a point that scanners write [bits]; a coordinate alone has more."""


def read_e57(path: Path) -> tuple[NDArray[np.float64], None]:
    """Return the valid points of all scans of an E57 file [n, 3] [m], in the frame that the scans have in common.

    Raises:
        Exception: the file is damaged or truncated; a ValueError has a text for the user.
    """
    with from_extra("formats", f"{path} and other E57 files"):
        import pye57
    with open_user_file(path) as file, pye57.E57(_name_of(file.fileno(), path)) as scans:
        headers = [scans.get_header(index) for index in range(scans.scan_count)]
        check_count(sum(header.point_count for header in headers), path.stat().st_size * 8 // _BITS_MIN)
        parts = [np.zeros((0, 3))]
        for index in range(len(headers)):
            scan = scans.read_scan(index, ignore_missing_fields=True)
            parts.append(np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"]))
    return np.concatenate(parts), None


def _name_of(descriptor: int, path: Path) -> str:
    """Return a name that an open file keeps if another file takes its place; its path where there is no such name."""
    name = Path(f"/proc/self/fd/{descriptor}")
    return str(name if name.exists() else path)
