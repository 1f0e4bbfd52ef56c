"""Analysis of pictures of the page: colours, and projection of points of the world."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.rollouts import cost_scale
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW
from aero_viz.planners import Plan

Image = NDArray[np.uint8]


def count(image: Image, color: ArrayLike, *, tolerance: int = 24) -> int:
    """Return the number of opaque pixels near `color` in a picture of shape [height, width, 3 or 4]."""
    near = np.abs(image[..., :3].astype(int) - np.asarray(color, dtype=int)).max(axis=-1) <= tolerance
    return int((near & (image[..., -1] > 128)).sum()) if image.shape[-1] == 4 else int(near.sum())


def ghost_pixels(image: Image) -> int:
    """Return the number of pixels of the ghost. Shades of the white drone are less blue."""
    pixels = image[..., :3].astype(int)
    is_near = np.abs(pixels - palette.GHOST).max(axis=-1) <= 40
    return int((is_near & (pixels[..., 2] - pixels[..., 1] > 25)).sum())


def differing(image: Image, reference: Image) -> int:
    """Return the number of pixels whose colour clearly differs between two pictures."""
    return int((np.abs(image[..., :3].astype(int) - reference[..., :3]).max(axis=-1) > 30).sum())


def project(points: ArrayLike, position: ArrayLike, look_at: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the pixels (row, column) of world points, for a pinhole camera with z up and a picture of this shape."""
    position, look_at = np.asarray(position, dtype=np.float64), np.asarray(look_at, dtype=np.float64)
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    local = (np.asarray(points) - position) @ np.stack((right, np.cross(forward, right), forward), axis=1)
    focal = 0.5 * shape[0] / np.tan(0.5 * FIELD_OF_VIEW)
    pixel = focal * local[:, :2] / local[:, 2:] + (0.5 * shape[1], 0.5 * shape[0])
    return pixel[:, ::-1].round().astype(int)


def rollouts_drawn(image: Image, plan: Plan, position: ArrayLike, look_at: ArrayLike) -> NDArray[np.float64]:
    """Return the share of each rollout's vertices that are drawn in its colour, 0 for a rollout outside the picture.

    The picture is taken from `position` toward `look_at` [m], each of shape [3].
    """
    colors = palette.colorize(cost_scale(plan), 0.0, 1.0, palette.COST).astype(int)
    colors[int(plan.best)] = palette.CHOSEN
    pixels = [project(path[4:], position, look_at, image.shape) for path in plan.positions]
    return np.array([_share(image, at, color) for at, color in zip(pixels, colors, strict=True)])


def _share(image: Image, pixels: NDArray[np.int64], color: ArrayLike) -> float:
    """Return the share of the pixels that have `color` themselves or in a neighbour."""
    height, width = image.shape[:2]
    inside = pixels[(pixels > 1).all(axis=1) & (pixels[:, 0] < height - 2) & (pixels[:, 1] < width - 2)]
    hits = [
        np.abs(image[r - 1 : r + 2, c - 1 : c + 2, :3].astype(int) - color).max(axis=-1).min() <= 22 for r, c in inside
    ]
    return float(np.mean(hits)) if len(hits) else 0.0
