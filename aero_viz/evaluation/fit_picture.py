"""A picture of a cloud beside the solids that were fitted to it, from above and from the side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_planner.output_files import whole_file
from aero_viz.errors import UserError
from aero_viz.evaluation.world_export import surface_points
from aero_viz.scenes.from_cloud import FittedWorld

_WIDTH = 900
"""Width of one view [pixels]."""
_HEIGHT_MAX = 700
_COLORS = {"ground": (86, 98, 118), "trunks": (146, 228, 118), "walls": (253, 195, 40), "mesh": (110, 190, 255),
           "voxels": (255, 82, 82)}  # fmt: skip
_BACKGROUND, _TEXT = (20, 25, 34), (214, 222, 234)
_LINE = 22
"""Height of a line of text [pixels]."""


def draw_fit(fitted: FittedWorld, path: Path) -> None:
    """Write a PNG file: the points on the left, coloured by height, and the solids on the right, by their kind.

    Raises:
        UserError: the file cannot be written.
    """
    import imageio.v3 as iio
    from PIL import Image, ImageDraw

    low, high = fitted.points.min(axis=0), fitted.points.max(axis=0)
    side = int(np.argmax((high - low)[:2]))
    pixel = float(max((high - low)[:2].max() / _WIDTH, (high - low).min() / _HEIGHT_MAX, 0.01))
    before = fitted.points, _by_height(fitted.points[:, 2])
    views = [(side, 1 - side), (side, 2)]
    panels = [
        np.vstack([_view(points, colors, low, high, pixel, axes) for axes in views])
        for points, colors in (before, _solids(fitted, pixel))
    ]
    gap = np.full((len(panels[0]), 4, 3), _TEXT, np.uint8)
    image = np.concatenate([panels[0], gap, panels[1]], axis=1)
    canvas = Image.fromarray(np.concatenate([np.full((_LINE, image.shape[1], 3), _BACKGROUND, np.uint8), image]))
    draw = ImageDraw.Draw(canvas)
    draw.text((8, 5), f"{len(fitted.points)} points, {high[side] - low[side]:.0f} m wide", fill=_TEXT)
    x = panels[0].shape[1] + 12
    for name, color in _COLORS.items():
        draw.text((x, 5), name, fill=color)
        x += 60
    try:
        with whole_file(path, alone=True) as partial:
            partial.write_bytes(iio.imwrite("<bytes>", np.asarray(canvas), extension=".png"))
    except OSError as error:
        raise UserError(f"The picture {path} cannot be written: {error.strerror or error}.") from error


def _solids(fitted: FittedWorld, pixel: float) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return points on the surfaces [n, 3] and their colours [n, 3]."""
    world, (first, last) = fitted.world, (fitted.walls, len(fitted.world.boxes) - fitted.voxels)
    none = {"cylinders": np.zeros((0, 8)), "boxes": np.zeros((0, 7)), "triangles": np.zeros((0, 9))}
    parts = {
        "ground": {"boxes": world.boxes[first:last], "triangles": world.triangles[fitted.mesh :]},
        "trunks": {"cylinders": world.cylinders},
        "walls": {"boxes": world.boxes[:first]},
        "mesh": {"triangles": world.triangles[: fitted.mesh]},
        "voxels": {"boxes": world.boxes[last:]},
    }
    found = [surface_points(replace(world, **{**none, **tables}), spacing=2.0 * pixel) for tables in parts.values()]
    colors = [
        np.tile(np.array(_COLORS[name], np.uint8), (len(part), 1)) for name, part in zip(parts, found, strict=True)
    ]
    return np.vstack(found), np.vstack(colors)


def _view(points, colors, low, high, pixel: float, axes: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the view along the third axis [rows, columns, 3]; what is nearer to the eye covers the rest."""
    across, up = axes
    depth = 3 - across - up
    order = np.argsort(points[:, depth] if depth == 2 else -points[:, depth], kind="stable")
    shape = np.ceil((high - low) / pixel).astype(int) + 3
    image = np.full((shape[up] + 8, shape[across], 3), _BACKGROUND, np.uint8)
    place = np.clip(((points - low) / pixel).astype(int), 0, shape - 2)[order]
    for row in (0, 1):  # a point is 2 x 2 pixels
        for column in (0, 1):
            image[shape[up] - 1 - place[:, up] - row + 1, place[:, across] + column] = colors[order]
    return image


def _by_height(height: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours from blue, low, to yellow, high [n, 3]."""
    low, high = np.quantile(height, [0.02, 0.98])
    share = np.clip((height - low) / max(high - low, 0.1), 0.0, 1.0)[:, None]
    return (share * np.array([253, 220, 90]) + (1.0 - share) * np.array([60, 90, 200])).astype(np.uint8)
