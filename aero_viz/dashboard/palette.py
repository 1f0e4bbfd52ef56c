"""Colours and colormaps of the page, each with one meaning, in the scene, in the legend and in the panels.

Colours that mean something differ from each other and from all colormaps, for readers with a red-green deficiency, too.
The light scene is the dark one with its lightness turned over: a colour keeps its hue, its contrast and its meaning.
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
PAPER: Rgb = (0, 0, 0)
PAPER_HORIZON: Rgb = (7, 8, 11)
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

DRONE: Rgb = (232, 226, 234)
NOSE = DRONE
DRONE_DARK: Rgb = (44, 50, 60)
ROTOR: Rgb = (150, 200, 255)
CHOSEN: Rgb = (146, 228, 118)
GUIDE: Rgb = (98, 161, 235)
ENDPOINT: Rgb = (108, 173, 176)
ANCHOR: Rgb = (145, 212, 196)
GOAL: Rgb = (217, 236, 170)
GHOST: Rgb = (185, 177, 222)
RECORDED: Rgb = (89, 94, 232)
SELECTED: Rgb = (195, 87, 194)
MOVING: Rgb = (142, 133, 14)
CONTINUED: Rgb = (154, 103, 144)
UNSEEN: Rgb = (55, 168, 107)
OCCLUDED: Rgb = (169, 84, 66)

GOOD: Rgb = (57, 204, 142)
WARNING: Rgb = (250, 176, 5)
BAD: Rgb = (255, 82, 82)
MUTED: Rgb = (134, 146, 164)

CURVES: tuple[Rgb, ...] = (
    (72, 149, 246), (240, 141, 49), (44, 184, 116), (172, 118, 232), (236, 84, 92), (22, 176, 190), (196, 160, 40)
)  # fmt: skip
"""Colours of curves, which can be seen on dark and on light panels."""
MEANINGS: dict[Rgb, str] = {
    DRONE: "the drone, and where it has flown",
    OBSTACLE: "obstacles",
    CHOSEN: "the plan that is flown",
    GUIDE: "guides",
    ENDPOINT: "endpoints before the refinement",
    ANCHOR: "anchors, and their cells",
    GOAL: "the goal, and waypoints that were not passed",
    GHOST: "the other flight: configuration A, or the future before a fork",
    RECORDED: "what a file has recorded",
    SELECTED: "what a visitor has selected",
    MOVING: "dynamic obstacles",
    CONTINUED: "surfaces that are continued, not measured",
    UNSEEN: "space that is not seen, and assumed to be free",
    OCCLUDED: "space that is occluded",
    GOOD: "all is well",
    WARNING: "attention",
    BAD: "a failure",
}
"""What each colour means."""

OUTCOMES: dict[str, Rgb] = {"arrived": GOOD, "collision": BAD, "end": MUTED}
"""Colours of the outcomes of flights; the others have that of a warning."""


def colormap(name: str) -> Colormap:
    """Return the rows of a colormap as sRGB, shape [n, 3]."""
    return (255 * cmap.Colormap(name).lut()[:, :3]).astype(np.uint8)


COST = colormap("plasma")[62:210]
"""Cost from bad to good, without the ends, which are hard to see in the scene or belong to ranges."""
HEIGHT = colormap("viridis")[70:140]
"""Height from low to high, without the dark end, which is hard to see on the ground, and the end of other greens."""
NEAR_TO_FAR = np.array(
    [
        np.interp(np.linspace(0.0, 1.0, 256), (0.0, 0.5, 1.0), ends)
        for ends in ((253, 140, 44), (231, 138, 74), (55, 122, 196))
    ]
).T.astype(np.uint8)
"""Range: yellow is near, blue is far."""
SHARES = colormap("colorbrewer:blues")[70:215]
"""Parts of a whole, in a panel."""


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


_INVERTED = 0.88
"""Share of the inversion: less than all of it keeps the hues of what becomes dark."""
TURNED_OVER = f"invert({_INVERTED}) hue-rotate(180deg) brightness({1.0 / _INVERTED:.4f})"
"""Filter of CSS that makes the light scene of the dark one."""
_LUMA = np.array([0.213, 0.715, 0.072])
_HALF_TURN = 2.0 * _LUMA[:, None] - np.eye(3)


def turned_over(colors: ArrayLike) -> NDArray[np.uint8]:
    """Return colours of the dark scene, shape [..., 3], as the light scene shows them: what the filter computes."""
    inverted = 255.0 * _INVERTED + (1.0 - 2.0 * _INVERTED) * np.asarray(colors, dtype=np.float32)
    turned = np.clip(inverted @ _HALF_TURN, 0.0, 255.0)
    return np.clip(turned / _INVERTED, 0.0, 255.0).round().astype(np.uint8)


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
