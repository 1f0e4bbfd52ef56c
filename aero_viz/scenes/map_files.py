"""Points, triangles and solids from the maps, meshes and worlds of other programs.

A separate process decodes them, because the libraries crash, hang or allocate as much memory as a damaged header
declares. A large file also does not slow down a session that is flying.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.scenes.decoder_checks import refuse_pointer
from aero_viz.scenes.decoding_process import DecodingProcess
from aero_viz.scenes.solids import Solids
from aero_viz.scenes.text_cloud import TEXT_SUFFIXES

Points = NDArray[np.float64]
_logger = logging.getLogger(__name__)

_POINTS = (".pcd", ".ply", ".las", ".laz", ".e57", ".npy", *TEXT_SUFFIXES)
MESH_SUFFIXES = (".obj", ".stl", ".glb", ".off")
MAP_SUFFIXES = (*_POINTS, *MESH_SUFFIXES)
"""File name suffixes that `read_points` and `read_mesh` read."""
SOLID_SUFFIXES = (".world", ".sdf", ".png", ".pgm", ".yaml", ".yml")
"""File name suffixes that `read_solids` reads."""


def has_voxels(path: str | Path) -> bool:
    """Return True if the name of a file is that of a point map or of an occupancy image."""
    return Path(path).suffix.lower() in (*_POINTS, ".png", ".pgm", ".yaml", ".yml")


def read_points(path: str | Path, process: DecodingProcess | None = None) -> Points:
    """Return the points of a file [m], float64 [n, 3], without rows that are not finite.

    Formats: PCD (ascii, binary, binary_compressed), PLY, LAS, LAZ, NPY with rows x, y, z, .., and texts (XYZ, PTS, ASC,
    CSV, TXT; see `text_cloud`).

    Args:
        path: the file.
        process: decodes it; None starts one for this file.

    Raises:
        UserError: the file cannot be read, is damaged or truncated, or holds no points.
    """
    path = Path(path)
    if path.suffix.lower() not in _POINTS:
        raise UserError(f"{path} is not a map: its name must end in one of {', '.join(MAP_SUFFIXES)}.")
    return _points(path, _decode(path, "map", "points", process))


def read_timed_points(
    path: Path, process: DecodingProcess, suffix: str | None = None
) -> tuple[Points, NDArray[Any] | None]:
    """Return the points of a file as `read_points` does, and their times [n] as stored, or None.

    PCD, PLY, LAS, LAZ and NPY with named fields may have times; their unit is that of `aero_viz.point_times`. A suffix
    names the format of a file that is named otherwise.
    """
    with _named(path, "cloud"):
        points, times = process.decode_points(path, suffix)
    return _points(path, points, "cloud"), times


def read_mesh(path: str | Path) -> Points:
    """Return the triangles of a mesh [m], float64 [n, 9], without degenerate ones; empty for a file of points.

    Formats: OBJ, STL, GLB, OFF, and PLY with faces; in metres, z up. No other file that a mesh names is opened.

    Raises:
        UserError: the file cannot be read, is damaged, or holds no triangles although its format is one of meshes.
    """
    path = Path(path)
    if path.suffix.lower() not in (*MESH_SUFFIXES, ".ply"):
        return np.zeros((0, 9))
    return _triangles(path, _decode(path, "mesh", "mesh"))


def read_map(path: str | Path, process: DecodingProcess | None = None) -> Points:
    """Return the triangles [n, 9] of `read_mesh` or, for a file of points, the points [n, 3] of `read_points`.

    Args:
        path: the file.
        process: decodes it; None starts one for this file.

    Raises:
        UserError: see there.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*MESH_SUFFIXES, ".ply"):
        return read_points(path, process)
    table = _decode(path, "mesh" if suffix in MESH_SUFFIXES else "map", "any", process)
    return _points(path, table) if table.shape[1] == 3 else _triangles(path, table)


def read_solids(path: str | Path, *, pixel: float | None = None) -> Solids:
    """Return the solids of a Gazebo world (SDF), or of an occupancy image or the YAML file of a map of ROS.

    Args:
        path: the file.
        pixel: edge of a pixel [m]; None takes that of the YAML file, or 0.1 m without one.

    Raises:
        UserError: the file cannot be read, is damaged, or holds no obstacles.
    """
    path = Path(path)
    try:
        refuse_pointer(path)
        with open_user_file(path) as file:
            file.read(1)
        with DecodingProcess() as process:
            solids = process.solids(path, pixel)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"Cannot read the world {path}: {reason.rstrip('.')}.") from error
    parts = ", ".join(f"{count} of the kind {kind}" for kind, count in solids.left_out.items())
    if not (solids.cylinders or solids.boxes or solids.spheres or solids.triangles):
        raise UserError(f"{path} has no cylinders, boxes or spheres" + (f", only {parts}." if parts else "."))
    if parts:
        _logger.warning("%s: left out %s; the world has only its cylinders, boxes and spheres.", path, parts)
    return solids


def _decode(path: Path, noun: str, content: str, process: DecodingProcess | None = None) -> Points:
    with _named(path, noun), nullcontext(process) if process is not None else DecodingProcess() as decoder:
        if path.suffix.lower() in (".las", ".laz") and (notice := decoder.las_units(path).notice):
            _logger.warning("%s: %s", path, notice)
        return decoder.decode(path, content)


@contextmanager
def _named(path: Path, noun: str) -> Iterator[None]:
    """Check that there is a file with content, and turn errors of reading it into a UserError."""
    try:
        refuse_pointer(path)
        with open_user_file(path) as file:
            is_empty = not file.read(1)
        if is_empty:
            raise ValueError("it is empty")
        yield
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"Cannot read the {noun} {path}: {reason.rstrip('.')}.") from error


def _points(path: Path, table: Points, noun: str = "map") -> Points:
    if len(table) == 0:
        raise UserError(f"{path} holds no finite points; give a {noun} with at least one.")
    return table


def _triangles(path: Path, table: Points) -> Points:
    if len(table) == 0 and path.suffix.lower() in MESH_SUFFIXES:
        raise UserError(f"{path} holds no triangles; give a mesh with at least one.")
    return table
