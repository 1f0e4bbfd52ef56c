"""Occupancy images: mazes as PNG or PGM files, with the YAML file of ROS's map server where there is one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from aero_planner.plain_yaml import plain_values
from aero_planner.user_file import open_companion, open_user_file, read_user_text
from aero_viz.input_limits import IMAGE_PIXELS_MAX, METADATA_MAX
from aero_viz.scenes.solids import Solids

IMAGE_SUFFIXES = (".png", ".pgm")
PIXEL = 0.1
"""Edge of a pixel of an image without a YAML file [m], as in kr_param_map."""
HEIGHT = 3.0
"""Height of the walls, which stand between a floor at z = 0 and a ceiling [m]."""
_SLAB = 0.5  # thickness of floor and ceiling [m]
_DEFAULTS: dict[str, Any] = {"resolution": PIXEL, "origin": [0.0, 0.0, 0.0], "negate": 0, "occupied_thresh": 0.65}


def read_occupancy(path: Path, pixel: float | None = None) -> Solids:
    """Return walls, floor and ceiling.

    A pixel is occupied where 1 - brightness, or brightness where the image is negated, exceeds `occupied_thresh`; one
    that is transparent or unknown is free. The lowest row of pixels begins at the origin.

    Args:
        path: image, whose settings are in the YAML file of the same name if there is one, or YAML file.
        pixel: edge of a pixel [m]; None takes that of the YAML file, or 0.1 m without one.

    Raises:
        ValueError: the image or the YAML file is damaged, or a value is out of range.
        OSError: a file cannot be opened.
    """
    settings, image = _settings(path)
    if pixel is not None:
        settings["resolution"] = pixel
    try:
        edge, threshold = float(settings["resolution"]), float(settings["occupied_thresh"])
        x, y, yaw = (float(value) for value in settings["origin"])
    except (TypeError, ValueError):
        raise ValueError("resolution and occupied_thresh must be numbers, and origin three of them") from None
    if not 1e-3 <= edge <= 10.0 or not all(map(math.isfinite, (x, y, yaw, threshold))):
        raise ValueError(f"its resolution is {edge:g} m per pixel; it must be in [0.001, 10], and all values finite")
    if yaw:
        raise ValueError(f"its origin is turned by {yaw:g} rad; turn the image instead, and set the angle to 0")
    occupied = _occupied(image, threshold, bool(settings["negate"]))
    solids, (rows, columns) = Solids(), occupied.shape
    for row, column, height, width in _rectangles(occupied):
        centre = x + edge * (column + 0.5 * width), y + edge * (row + 0.5 * height), 0.5 * HEIGHT
        solids.boxes.append(np.array([*centre, edge * width, edge * height, HEIGHT, 0.0]))
    middle, extent = (x + 0.5 * edge * columns, y + 0.5 * edge * rows), (edge * columns, edge * rows)
    solids.ground = np.array([*middle, -0.5 * _SLAB, *extent, _SLAB, 0.0])
    solids.boxes.append(np.array([*middle, HEIGHT + 0.5 * _SLAB, *extent, _SLAB, 0.0]))
    return solids


def _settings(path: Path) -> tuple[dict[str, Any], BinaryIO]:
    """Return the settings, completed by defaults, and the image."""
    is_image = path.suffix.lower() in IMAGE_SUFFIXES
    found = [path.with_suffix(suffix) for suffix in (".yaml", ".yml")] if is_image else [path]
    file = next((candidate for candidate in found if candidate.is_file()), None)
    if file is None:
        if not is_image:
            raise FileNotFoundError(2, "No such file or directory")
        return dict(_DEFAULTS), open_user_file(path)
    try:
        content = plain_values(read_user_text(file, limit=METADATA_MAX), ("image", *_DEFAULTS))
    except ValueError as error:
        raise ValueError(f"{file.name} is {error}") from error
    if not isinstance(content.get("image"), str):
        if is_image:  # it belongs to something else
            return dict(_DEFAULTS), open_user_file(path)
        raise ValueError("it is not a map of ROS: the key image with the name of a PNG or PGM file is missing")
    name = content.pop("image")
    if Path(name).suffix.lower() not in IMAGE_SUFFIXES:
        raise ValueError(f"it names the image {name[:60]!r}; it must be a PNG or PGM file")
    return {**_DEFAULTS, **content}, open_user_file(path) if is_image else open_companion(file, name)


def _occupied(file: BinaryIO, threshold: float, negate: bool) -> NDArray[np.bool_]:
    """Return the occupied pixels of an image [rows, columns], the lowest row first."""
    from PIL import Image

    with file, Image.open(file, formats=("PNG", "PPM")) as image:
        if image.width * image.height > IMAGE_PIXELS_MAX:
            raise ValueError(f"it has {image.width} x {image.height} pixels, and at most {IMAGE_PIXELS_MAX} are read")
        table = np.asarray(image.convert("RGBA"), dtype=np.float32)[::-1]
    brightness = table[..., :3].mean(axis=2) / 255.0
    return ((brightness if negate else 1.0 - brightness) > threshold) & (table[..., 3] > 0.0)


def _rectangles(occupied: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Return rectangles that cover exactly the occupied pixels: first row and column, height and width [pixels]."""
    open_runs: dict[tuple[int, int], int] = {}
    found = []
    for row in range(len(occupied) + 1):
        line = occupied[row] if row < len(occupied) else np.zeros(occupied.shape[1], bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        runs = {(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)}
        for run in [run for run in open_runs if run not in runs]:
            first = open_runs.pop(run)
            found.append((first, run[0], row - first, run[1] - run[0]))
        for run in runs:
            open_runs.setdefault(run, row)
    return found
