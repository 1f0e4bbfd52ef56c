"""Colours and colormaps of the page.

Each layer has its own hue, in the scene, in the legend and in the status panel:

    rollouts   COST by Stage II cost, bright is good          chosen     green
    cloud      HEIGHT by height, or  NEAR_TO_FAR by range     guides     blue
    endpoints  grey before the refinement, cyan after         goal       rose
    selection  magenta
    drone      white with an orange nose, orange trail        recording  violet
    cells      NEAR_TO_FAR by range where measured        directions VIRIDIS by free range
               pale lilac where continued, brown where unseen, indigo where occluded
"""

from __future__ import annotations

import cmap
import numpy as np
from numpy.typing import ArrayLike, NDArray

Rgb = tuple[int, int, int]
Colormap = NDArray[np.uint8]
"""Colours from low to high, sRGB, shape [n, 3]."""

SKY_TOP: Rgb = (12, 16, 24)
SKY_HORIZON: Rgb = (30, 38, 52)
FOG: Rgb = (22, 28, 39)
GROUND: Rgb = (23, 29, 40)
GRID_CELL: Rgb = (36, 45, 60)
GRID_SECTION: Rgb = (54, 67, 88)
OBSTACLE: Rgb = (78, 92, 114)
BRAND: Rgb = (58, 134, 255)

PANEL: dict[int, Rgb] = {
    4: (51, 61, 78),
    5: (38, 46, 60),
    6: (30, 37, 49),
    7: (20, 25, 34),
    8: (15, 19, 26),
    9: (10, 13, 19),
}
"""Shades of the panels, by number in the page's theme."""

DRONE: Rgb = (236, 240, 246)
DRONE_DARK: Rgb = (44, 50, 60)
ROTOR: Rgb = (150, 200, 255)
NOSE: Rgb = (240, 151, 57)
TRAIL: Rgb = (214, 222, 234)
GHOST: Rgb = (214, 132, 190)
CHOSEN: Rgb = (146, 228, 118)
GUIDE: Rgb = (72, 149, 226)
ENDPOINT: Rgb = (138, 150, 168)
ANCHOR: Rgb = (110, 214, 210)
GOAL: Rgb = (246, 58, 118)
RECORDED: Rgb = (178, 131, 227)
RECORDED_PLAN: Rgb = (206, 160, 250)
SELECTED: Rgb = (255, 70, 255)
MOVING: Rgb = (255, 128, 72)
CONTINUED: Rgb = (208, 196, 232)
UNSEEN: Rgb = (196, 120, 92)
OCCLUDED: Rgb = (96, 92, 190)

GOOD: Rgb = (52, 211, 123)
WARNING: Rgb = (250, 176, 5)
BAD: Rgb = (255, 82, 82)
MUTED: Rgb = (134, 146, 164)

CURVES: tuple[Rgb, ...] = (
    (72, 149, 246), (240, 141, 49), (44, 184, 116), (172, 118, 232), (236, 84, 92), (22, 176, 190), (196, 160, 40)
)  # fmt: skip
"""Colours of curves, which can be seen on dark and on light panels."""

OUTCOMES: dict[str, Rgb] = {"arrived": GOOD, "collision": BAD, "end": MUTED}
"""Colours of the outcomes of flights; the others have that of a warning."""


def colormap(name: str) -> Colormap:
    """Return the rows of a colormap as sRGB, shape [n, 3]."""
    return (255 * cmap.Colormap(name).lut()[:, :3]).astype(np.uint8)


VIRIDIS = colormap("viridis")
PLASMA = colormap("plasma")
COST = PLASMA[62:224]
"""Stage II cost from bad to good, without the ends, which are hard to see in the scene."""
HEIGHT = VIRIDIS[70:]
"""Height from low to high, without the dark end, which is hard to see on the ground."""
NEAR_TO_FAR = colormap("turbo")[20:236][::-1]
"""Range: red is near, blue is far, without the ends, which are too dark for the scene."""


def colorize(values: ArrayLike, low: float, high: float, colormap: Colormap) -> NDArray[np.uint8]:
    """Return the colour of each value, shape [..., 3]. Values at or below `low` get the first colour of the map.

    Values must not be NaN.
    """
    last = len(colormap) - 1
    rows = np.array(values, dtype=np.float32)
    rows -= np.float32(low)
    rows *= np.float32(last / max(high - low, 1e-9))
    np.clip(rows, 0.0, last, out=rows)
    return colormap.take(rows.astype(np.uint8), axis=0)


# The ACES filmic curve as in three.js: a matrix, then (v (v + a) - b) / (v (c v + d) + e), then another matrix.
_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566], [0.0284, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_A, _B, _C, _D, _E = 0.0245786, 0.000090537, 0.983729, 0.432951, 0.238081
_EXPOSURE = 1.0 / 0.6
_MEDIUM_LIGHT = 0.45
"""Light on a surface that faces the viewer, as a share of full light."""


def unmapped(colors: ArrayLike) -> NDArray[np.uint8]:
    """Return the vertex colours of lines that make `colors` appear on the page, shape [..., 3].

    The page takes vertex colours as linear light and applies the ACES film curve, which would turn them into pastels.
    This is the inverse, up to the end of the curve: the brightest colours come out slightly darker.
    """
    return np.clip(255.0 * _light(colors), 0.0, 255.0).round().astype(np.uint8)


def lit(colors: ArrayLike) -> NDArray[np.uint8]:
    """Return the colours of instances of a mesh that make `colors` appear on the page, shape [..., 3].

    The page takes them as linear light, like those of lines, and multiplies them by the light that falls on the mesh.
    The inverse holds for a medium light; surfaces toward the sun come out brighter.
    """
    return np.clip(255.0 / _MEDIUM_LIGHT * _light(colors), 0.0, 255.0).round().astype(np.uint8)


def linear(colors: ArrayLike) -> NDArray[np.uint8]:
    """Return the colours of instances of a mesh that look like one mesh in `colors`, shape [..., 3]."""
    return (255.0 * _linear(colors)).round().astype(np.uint8)


def _linear(colors: ArrayLike) -> NDArray[np.float64]:
    shown = np.asarray(colors, dtype=np.float64) / 255.0
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def _light(colors: ArrayLike) -> NDArray[np.float64]:
    """Return the linear light that the film curve turns into `colors`, shape [..., 3]."""
    y = np.clip(_linear(colors) @ np.linalg.inv(_ACES_OUT).T, 0.0, 0.76)
    p, q, r = 1.0 - _C * y, _A - _D * y, -_B - _E * y
    v = (-q + np.sqrt(q * q - 4.0 * p * r)) / (2.0 * p)
    return v @ np.linalg.inv(_ACES_IN).T / _EXPOSURE


def as_rgb(colors: NDArray[np.uint8]) -> list[Rgb]:
    """Return an array of colours, shape [n, 3], as tuples."""
    return [(int(r), int(g), int(b)) for r, g, b in colors]


def css(color: Rgb, alpha: float = 1.0) -> str:
    """Return `color` as CSS."""
    return f"rgba({color[0]},{color[1]},{color[2]},{alpha:g})"


def gradient(colormap: Colormap) -> str:
    """Return a colormap as a CSS gradient from left (low) to right (high)."""
    rows = np.linspace(0, len(colormap) - 1, 16).astype(int)
    return f"linear-gradient(90deg,{','.join(css(color) for color in as_rgb(colormap[rows]))})"
