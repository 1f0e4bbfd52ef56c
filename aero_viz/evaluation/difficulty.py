"""Difficulty of a world by the metrics of FlightBench (Yu et al., arXiv 2406.05687).

They describe what a drone meets along a *guide*, a short path from start to goal with free space for the drone. The
constants are those of the authors' program (`cal_difficulty.py`), so that the numbers can be compared with their table:
a sensing range s = 4 m, a drone of radius 0.15 m, and a cone of 36 degrees around the direction of flight. Obstacles
are points on all surfaces, the ground among them, 0.15 m apart.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.evaluation.world_export import surface_points
from aero_viz.scenes import World
from aero_viz.scenes.clearance_grid import ClearanceGrid, search_box
from aero_viz.scenes.passable import is_passable
from aero_viz.scenes.primitives import primitive_bounds

if TYPE_CHECKING:
    from scipy.spatial import KDTree

Points = NDArray[np.float64]

_RANGE = 4.0  # s [m]
_RADIUS = 0.15  # of the drone [m]
_SPACING = 0.15  # between points of the obstacles [m]
_CELL = 0.2  # of the grid in which the guide is searched [m]
_DETOUR = 20.0  # by which the guide may leave the box around start and goal [m]
_CORRIDORS, _CANDIDATES = 8, 40
_STEP = 0.3  # between points of the guide around which a ball is searched [m]
_RINGS = ((15.0, 0.0, 0.55), (22.5, 15.0, 0.3), (30.0, 22.5, 0.1), (36.0, 30.0, 0.05))
"""Rings of the field of view: outer and inner angle to the direction of flight [deg], and weight w."""


@dataclasses.dataclass(frozen=True)
class Difficulty:
    """Difficulty of flying through a world; larger is harder."""

    traversability_obstruction: float
    """TO = s / (2 N) sum_{i=1..N} 1 / r_i, with r_1 <= r_2 <= .. the radii of the balls of a corridor along the guide,
    N half their number, and r at most s: 0.5 in free space. The smallest of eight corridors."""
    view_occlusion: float
    """VO = 1 / K sum_{k=1..K} sum_j w_j s / d_jk, with d_jk the distance from point k of the guide, one every 0.4 m, to
    the nearest obstacle in ring j of the field of view within s. A ring without one adds nothing: 0 in free space."""
    angle_over_length: float
    """AOL = 1 / L sum_i (exp(2 theta_i / pi) - 1) [1/m], with L the length of the guide and theta_i the angles [rad] by
    which it turns at its corners: 0 for a straight line."""
    guide_length: float
    """L [m]."""

    @property
    def total(self) -> float:
        """TO + VO + AOL, by which FlightBench's program orders worlds."""
        return self.traversability_obstruction + self.view_occlusion + self.angle_over_length

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the total as plain values for JSON."""
        return {**dataclasses.asdict(self), "difficulty": self.total}


def measure_difficulty(world: World, *, radius: float = 0.25) -> Difficulty | None:
    """Return the difficulty of a world, or None where no guide is found or it has no length. It is always the same.

    Args:
        world: obstacles, start and goal.
        radius: free space around the guide [m].
    """
    from scipy.spatial import KDTree  # takes 0.3 s to import

    guide = _find_guide(world, radius)
    if guide is None:
        return None
    length = float(np.linalg.norm(np.diff(guide, axis=0), axis=1).sum())
    if length == 0.0:  # the goal is the start
        return None
    points = surface_points(_nearby(world, _along(guide, 0.5)[0]), spacing=_SPACING)
    if len(points) == 0:
        return Difficulty(0.5, 0.0, _angle_over_length(guide, length), length)
    tree = KDTree(points)
    rng = np.random.default_rng(0)
    obstruction = min(_obstruction(_corridor(tree, guide, rng)) for _ in range(_CORRIDORS))
    return Difficulty(obstruction, _occlusion(tree, guide), _angle_over_length(guide, length), length)


def _find_guide(world: World, radius: float) -> Points | None:
    ends = np.stack([world.start, world.goal])
    wide = np.stack([ends.min(axis=0)[:2] - _DETOUR, ends.max(axis=0)[:2] + _DETOUR])
    field = np.clip(wide, *(corner[:2] for corner in search_box(world)))
    # The first threshold proves that the drone fits through between two neighbours. Only where there is no such route,
    # one that may just fit is searched, and then one around the field of obstacles.
    sure = math.sqrt(radius**2 + 0.75 * _CELL**2)
    for region, threshold in ((field, sure), (field, radius), (wide, sure)):
        grid = ClearanceGrid.measure(world, cell=_CELL, distance_max=1.01 * sure, region=region).cropped()
        route = grid.route(world.start, world.goal, threshold=threshold)
        if route is not None:
            return route
    return None


def _nearby(world: World, path: Points) -> World:
    """Return the parts of a world that lie within the sensing range of a path [n, 3]; boxes are cut to its extent."""
    low, high = path.min(axis=0) - _RANGE - 1.0, path.max(axis=0) + _RANGE + 1.0
    boxes = world.boxes.copy()
    straight = boxes[:, 6] == 0.0
    lower = np.maximum(boxes[:, :3] - 0.5 * boxes[:, 3:6], low)
    upper = np.minimum(boxes[:, :3] + 0.5 * boxes[:, 3:6], high)
    cut = straight & np.all(lower < upper, axis=1)
    boxes[cut, :3], boxes[cut, 3:6] = 0.5 * (lower + upper)[cut], (upper - lower)[cut]
    tables = {"cylinders": world.cylinders, "boxes": boxes, "spheres": world.spheres}
    kept: dict[str, Points] = {}
    for key, table in tables.items():
        others = {name: table if name == key else tables[name][:0] for name in tables}
        kept[key] = table[_is_near(*primitive_bounds(*others.values()), path)] if len(table) else table
    corners = world.triangles.reshape(-1, 3, 3)
    if len(corners):
        kept["triangles"] = world.triangles[_is_near(corners.min(axis=1), corners.max(axis=1), path)]
    return World(world.name, world.start, world.goal, bounds=world.bounds, mission=None, **kept)


def _is_near(lower: Points, upper: Points, path: Points) -> NDArray[np.bool_]:
    near = np.zeros(len(lower), dtype=bool)
    for position in path:
        gap = np.maximum(np.maximum(lower - position, position - upper), 0.0)
        near |= (gap * gap).sum(axis=1) <= (_RANGE + 1.0) ** 2
    return near


def _along(guide: Points, spacing: float) -> tuple[Points, Points]:
    """Return points on the guide [n, 3] and its directions there [n, 3], from `spacing` on to the end."""
    steps = np.diff(guide, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    ends = np.cumsum(lengths)
    at = np.append(np.arange(spacing, ends[-1], spacing), ends[-1])
    piece = np.minimum(np.searchsorted(ends, at, side="right"), len(steps) - 1)
    directions = steps[piece] / lengths[piece, None]
    return guide[piece] + (at - (ends - lengths)[piece])[:, None] * directions, directions


def _corridor(tree: KDTree, guide: Points, rng: np.random.Generator) -> list[float]:
    """Return the radii [m] of overlapping balls in free space from one end of the guide to the other.

    The next ball is chosen among balls around random points near the next point of the guide outside the last ball. Of
    those that overlap the last ball, the best has the largest score: 0.7 of its volume, 0.1 of the overlap, less 0.35
    of the way ahead of that point and 0.1 of the way aside (Ren et al. 2022, as in FlightBench).
    """
    centre, goal = guide[0], guide[-1]
    radius = float(_free_radius(tree, centre[None])[0])
    radii = [radius]
    for target in _along(guide, _STEP)[0]:
        if np.linalg.norm(goal - centre) < radius:
            break
        offset = target - centre
        if np.linalg.norm(offset) < radius:
            continue
        direction = offset / np.linalg.norm(offset)
        spread = 0.25 * np.linalg.norm(offset)
        noise = rng.normal(size=(_CANDIDATES, 3)) * spread
        ahead = noise[:, :1] * direction
        aside = 2.0 * (noise - (noise @ direction)[:, None] * direction)
        candidates = np.vstack([target, target + ahead + aside])
        found = _free_radius(tree, candidates)
        overlap = _overlap(radius, found, np.linalg.norm(candidates - centre, axis=1))
        price = np.append(0.4, 0.35 * (ahead @ direction) + 0.1 * np.linalg.norm(aside, axis=1))
        score = 0.7 * 4.0 / 3.0 * np.pi * found**3 + 0.1 * overlap - price
        score[(found <= 0.01) | (overlap <= 0.0)] = -np.inf
        best = int(score.argmax())
        if np.isfinite(score[best]):
            centre, radius = candidates[best], float(found[best])
            radii.append(radius)
    return radii


def _free_radius(tree: KDTree, points: Points) -> Points:
    return np.clip(tree.query(points)[0] - _RADIUS, 0.0, _RANGE)


def _overlap(radius: float, others: Points, distances: Points) -> Points:
    """Return the volumes [m^3] in which a ball overlaps others, 0 where one contains the other."""
    small, large = np.minimum(radius, others), np.maximum(radius, others)
    d = np.maximum(distances, 1e-9)
    # The volume of a lens: two caps.
    volume = (
        np.pi * (small + large - d) ** 2 * (d**2 + 2.0 * d * (small + large) - 3.0 * (large - small) ** 2) / (12 * d)
    )
    return np.where((d < small + large) & (d > large - small), volume, 0.0)


def _obstruction(radii: list[float]) -> float:
    half = np.sort(radii)[: max(1, len(radii) // 2)]
    return float(0.5 * _RANGE * np.mean(1.0 / np.maximum(half, 0.01)))


def _occlusion(tree: KDTree, guide: Points) -> float:
    total = 0.0
    positions, directions = _along(guide, 0.1 * _RANGE)
    for position, direction in zip(positions, directions, strict=True):
        offsets = tree.data[tree.query_ball_point(position, _RANGE)] - position
        distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        angles = np.degrees(np.arccos(np.clip(offsets @ direction / distances, -1.0, 1.0)))
        for outer, inner, weight in _RINGS:
            seen = distances[(angles <= outer) & (angles >= inner)]
            total += weight * _RANGE / float(seen.min()) if len(seen) else 0.0
    return total / len(positions)


def _angle_over_length(guide: Points, length: float) -> float:
    steps = np.diff(guide, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    angles = np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1.0, 1.0))
    return float(np.expm1(2.0 * angles / np.pi).sum() / length)


def describe_world(world: World, *, radius: float) -> dict[str, Any]:
    """Return whether a path exists among the static obstacles, and their difficulty, as plain values for JSON.

    The key is `passable`, followed by those of `Difficulty.to_dict`, which are None where there is no guide.

    Args:
        world: obstacles, start and goal.
        radius: radius of the drone [m].
    """
    world = world.standing()
    difficulty = measure_difficulty(world, radius=radius)
    names = [*(field.name for field in dataclasses.fields(Difficulty)), "difficulty"]
    metrics = dict.fromkeys(names) if difficulty is None else difficulty.to_dict()
    return {"passable": is_passable(world, radius=radius), **metrics}
