"""A map of one tick, seen from above, as SVG: obstacles, points, candidates, and where the drone hit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.explain.evidence import PlanEvidence
from aero_viz.planners.plan import ensemble

_HALF = 5.0
"""Half the width of the map [m]."""
_PIXELS = 60.0
"""Pixels per metre."""
_FONT = 26
"""Height of the text [pixels of the drawing], which a panel of the page shows at half the size."""
_LINE = 36
"""Height of a line of text [pixels of the drawing]."""
COLORS = {
    "safe": "#39cc8e",
    "unsafe": "#ff5252",
    "chosen": "#92e476",
    "braking": "#e8e2ea",
    "obstacle": "#4e5c72",
    "point": "#8692a4",
    "text": "#e8e2ea",
    "ground": "#141922",
}
"""Colours of the map, which are those of the page and its scene."""


def draw_map(evidence: PlanEvidence, end: ArrayLike | None = None) -> str:
    """Return the map around the drone. Obstacles are cut at its height; `end` is where it hit [m], shape [3]."""
    frame, plan, recorded = evidence.frame, evidence.plan, evidence.frame.recorded_plan
    drone = frame.drone_position
    size = 2.0 * _HALF * _PIXELS

    def place(points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixels: x of the world is up, y is left."""
        offset = points[..., :2] - drone[:2]
        return np.stack((_HALF - offset[..., 1], _HALF - offset[..., 0]), axis=-1) * _PIXELS

    def line(path: NDArray[np.float32], color: str, width: float, dash: str = "") -> str:
        points = " ".join(f"{x:.0f},{y:.0f}" for x, y in place(path.astype(np.float64)))
        return f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width}"{dash}/>'

    full = ensemble(plan)
    known = frame.observation.points if full is None else full.filtered_points
    cloud = place(np.asarray(known, dtype=np.float64))
    cloud = cloud[((cloud > 0.0) & (cloud < size)).all(axis=1)][:1500]
    points = "".join(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="1.6"/>' for x, y in cloud)
    parts = [_section(evidence, drone), f'<g fill="{COLORS["point"]}">{points}</g>']
    braking = None if full is None else full.braking
    if braking is not None:
        parts += [line(path, COLORS["braking"], 2.0, ' stroke-dasharray="7 5"') for path in braking.positions]
    parts += [
        line(path, COLORS["safe" if evidence.is_safe[m] else "unsafe"], 2.0)
        for m, path in enumerate(plan.positions)
        if m != plan.best or recorded is not None
    ]
    parts.append(line(plan.positions[int(plan.best)] if recorded is None else recorded.path, COLORS["chosen"], 5.0))
    x, y = place(drone)
    ink = COLORS["text"]
    parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{0.25 * _PIXELS:.0f}" fill="none" stroke="{ink}"/>')
    if end is not None:
        x, y = place(np.asarray(end, dtype=np.float64))
        parts.append(f'<path d="M{x - 9:.0f} {y - 9:.0f}l18 18m0 -18l-18 18" stroke="{ink}" stroke-width="4"/>')
    keys = [(name, COLORS[name]) for name in ("safe", "unsafe", "chosen")]
    keys.append(("- - braking", COLORS["braking"]))
    keys += [] if end is None else [("× the end", ink)]
    spans = " ".join(f'<tspan dx="8" fill="{color}">{label}</tspan>' for label, color in keys)
    again = "" if recorded is None else ", candidates computed again"
    caption = f"{frame.time:.2f} s, at {drone[2]:.1f} m height, {2.0 * _HALF:.0f} m wide{again}"
    foot = (
        f'<rect y="{size:.0f}" width="100%" height="100%" fill="{COLORS["ground"]}"/>'  # paths may leave the map
        f'<text y="{size + _LINE - 6:.0f}">{spans}</text>'
        f'<text x="8" y="{size + 2 * _LINE - 6:.0f}" fill="{ink}">{caption}</text>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size:.0f} {size + 2 * _LINE + 6:.0f}" '
        f'style="width:100%" font-family="sans-serif" font-size="{_FONT}">'
        f'<rect width="100%" height="100%" fill="{COLORS["ground"]}"/>{"".join(parts)}{foot}</svg>\n'
    )


def _section(evidence: PlanEvidence, drone: NDArray[np.float64], cells: int = 100) -> str:
    """Return the cells of a grid at the height of the drone whose centres lie inside an obstacle, row by row."""
    world = evidence.frame.world
    if world is None:
        return ""
    offsets = (np.arange(cells) + 0.5) * 2.0 * _HALF / cells - _HALF
    x, y = np.meshgrid(drone[0] - offsets, drone[1] - offsets, indexing="ij")
    inside = world.distance(np.stack((x, y, np.full_like(x, drone[2])), axis=-1)).reshape(x.shape) < 0.0
    side, rects = 2.0 * _HALF / cells * _PIXELS, []
    for row, line in enumerate(np.pad(inside, ((0, 0), (1, 1))).astype(int)):
        starts, ends = np.flatnonzero(np.diff(line) == 1), np.flatnonzero(np.diff(line) == -1)
        rects += [
            f'<rect x="{a * side:.0f}" y="{row * side:.0f}" width="{(b - a) * side:.0f}" height="{side + 0.5:.1f}"/>'
            for a, b in zip(starts, ends, strict=True)
        ]
    return f'<g fill="{COLORS["obstacle"]}">{"".join(rects)}</g>'
