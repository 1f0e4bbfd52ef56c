"""A benchmark of all worlds in a folder."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from pathlib import Path

from numpy.typing import ArrayLike

from aero_planner.user_file import read_user_bytes
from aero_viz.catalog import is_map, load_world
from aero_viz.errors import UserError
from aero_viz.evaluation.bench.result_folder import REPORT_FILES, holds_results
from aero_viz.evaluation.bench.suites import Benchmark, Row
from aero_viz.scenes.occupancy import IMAGE_SUFFIXES

_logger = logging.getLogger(__name__)


def folder_benchmark(
    folder: str | Path,
    *,
    speed: float,
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    voxel: float | None = None,
) -> Benchmark:
    """Return a benchmark with a row per world in a folder: JSON, map, mesh, Gazebo world or occupancy image.

    A world in JSON has its own start and goal; other worlds are flown across their longest side. A file that is not a
    world is left out with a message, and the report of a benchmark without.

    Args:
        folder: the folder; folders in it are not searched.
        speed: speed limit [m/s].
        start, goal: [m], [3], for all worlds; None leaves the choice.
        voxel: edge of the voxels of point-cloud maps, and of the pixels of images [m]; None leaves the choice.

    Raises:
        UserError: the folder cannot be read, or no file in it is a world.
    """
    folder = Path(folder)
    try:
        reports = REPORT_FILES if holds_results(folder) else ()
        files = sorted(p for p in folder.iterdir() if p.is_file() and _is_world(p) and p.name not in reports)
    except OSError as error:
        raise UserError(f"Cannot read the folder {folder}: {error.strerror or error}.") from error
    rows, worlds = [], {}
    for path in files:
        try:
            world = load_world(str(path), voxel=voxel, start=start, goal=goal, across=True)
        except UserError as error:
            _logger.warning("left out: %s", error)
            continue
        digest = hashlib.sha256(read_user_bytes(path)).hexdigest()
        worlds[path.name] = dataclasses.replace(world, name=path.stem)
        rows.append(Row(path.name, str(path), speed=speed, sha256=digest))
    if not rows:
        raise UserError(f"{folder} has no worlds: JSON files of worlds, maps, meshes, Gazebo worlds or images.")
    note = (
        "Each file is a world. Worlds in JSON have their own start and goal, others are crossed along the longest side."
    )
    return Benchmark("worlds", f"Worlds in {folder.name}", note, tuple(rows), worlds=worlds)


def _is_world(path: Path) -> bool:
    """Return True if the name of a file is that of a world, and it is not the YAML file of an image."""
    has_image = path.suffix.lower() in (".yaml", ".yml") and any(
        path.with_suffix(suffix).exists() for suffix in IMAGE_SUFFIXES
    )
    return (path.suffix.lower() == ".json" or is_map(str(path))) and not has_image
