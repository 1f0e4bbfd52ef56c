"""Obstacles that block a line of sight."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.scenes.primitives import DISTANCES, primitive_bounds
from aero_viz.scenes.world import World

_STEP = 0.3
"""Distance between the samples on a line [m]."""
_SAMPLES_MAX = 120

Array = NDArray[np.float64]


class SightLines:
    """Finds the obstacles of a world that block lines of sight. The ground blocks none.

    Args:
        world: obstacles.
    """

    def __init__(self, world: World) -> None:
        self._tables = {"cylinders": world.cylinders, "boxes": world.boxes[~world.ground], "spheres": world.spheres}
        self._spheres = {kind: _bounding_spheres(kind, table) for kind, table in self._tables.items()}
        self._triangles = world.triangles.reshape(-1, 3, 3)
        centers = self._triangles.mean(axis=1)
        reach = np.linalg.norm(self._triangles - centers[:, None], axis=2).max(axis=1, initial=0.0)
        self._spheres["triangles"] = (centers, reach)

    def blocked_by(self, eye: ArrayLike, targets: ArrayLike, radii: ArrayLike) -> dict[str, NDArray[np.int64]]:
        """Return the rows of the obstacles between an eye and any of the targets, by kind.

        The kinds are "cylinders", "boxes" (without the ground), "spheres" and "triangles". An obstacle that contains
        the eye is one of them.

        Args:
            eye: position of the eye [m], shape [3].
            targets: positions to see [m], shape [n, 3].
            radii: distance that obstacles must keep from the line to each target [m], shape [n].
        """
        start, ends = np.asarray(eye, dtype=np.float64), np.asarray(targets, dtype=np.float64)
        lines = [(start, end, float(radius)) for end, radius in zip(ends, np.asarray(radii), strict=True)]
        rows = {kind: [self._solids(kind, *line) for line in lines] for kind in self._tables}
        rows["triangles"] = [self._surface(*line) for line in lines]
        return {kind: np.unique(np.concatenate(found)) for kind, found in rows.items()}

    def ceiling(self, eye: ArrayLike, target: ArrayLike) -> float | None:
        """Return the lowest height of what lies flat above a target and hides it from an eye [m]; None without that.

        Args:
            eye: position of the eye [m], shape [3].
            target: position to see [m], shape [3].
        """
        place = np.asarray(target, dtype=np.float64)
        line = np.asarray(eye, dtype=np.float64), place, 0.05
        boxes = self._tables["boxes"][self._solids("boxes", *line)]
        triangles = self._triangles[self._surface(*line)]
        boxes = boxes[boxes[:, 3:5].min(axis=1) > 2.0 * boxes[:, 5]]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        flat = np.abs(normals[:, 2]) > 0.8 * np.linalg.norm(normals, axis=1)
        heights = np.concatenate((boxes[:, 2] - 0.5 * boxes[:, 5], triangles[flat, :, 2].min(axis=1, initial=np.inf)))
        heights = heights[heights > place[2]]
        return float(heights.min()) if len(heights) else None

    def _solids(self, kind: str, eye: Array, target: Array, radius: float) -> NDArray[np.int64]:
        near = self._near(kind, eye, target, radius)
        if not len(near):
            return near
        points = _samples(eye, target, radius)
        distance = DISTANCES[kind](points[:, None, :], self._tables[kind][near])
        return near[(distance < radius).any(axis=0)]

    def _surface(self, eye: Array, target: Array, radius: float) -> NDArray[np.int64]:
        """Small triangles block a line that passes within `radius`; large ones, a line that crosses them."""
        near = self._near("triangles", eye, target, radius)
        if not len(near):
            return near
        points = _samples(eye, target, radius)
        is_hit = self._spheres["triangles"][1][near] < radius
        # The crossing of the line and the plane of each triangle, after Moeller and Trumbore.
        ray = points[-1] - eye
        origin, edge1, edge2 = np.moveaxis(self._triangles[near], 1, 0)
        edge1, edge2 = edge1 - origin, edge2 - origin
        normal = np.cross(ray, edge2)
        determinant = np.sum(edge1 * normal, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = eye - origin
            u = np.sum(offset * normal, axis=1) / determinant
            across = np.cross(offset, edge1)
            v, t = (across @ ray) / determinant, np.sum(edge2 * across, axis=1) / determinant
            is_hit |= (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t >= 0.0) & (t <= 1.0)
        return near[is_hit]

    def _near(self, kind: str, eye: Array, target: Array, radius: float) -> NDArray[np.int64]:
        """Return the rows whose bounding sphere comes within `radius` of the line."""
        centers, reach = self._spheres[kind]
        if not len(centers):
            return np.zeros(0, dtype=np.int64)
        line = target - eye
        share = np.clip((centers - eye) @ line / max(line @ line, 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(eye + share[:, None] * line - centers, axis=1)
        return np.flatnonzero(distance < reach + radius)


def _bounding_spheres(kind: str, table: Array) -> tuple[Array, Array]:
    """Return centres [m], shape [n, 3], and radii [m], shape [n]."""
    empty = {"cylinders": np.zeros((0, 8)), "boxes": np.zeros((0, 7)), "spheres": np.zeros((0, 4))}
    lower, upper = primitive_bounds(**(empty | {kind: table}))
    return 0.5 * (lower + upper), 0.5 * np.linalg.norm(upper - lower, axis=1)


def _samples(eye: Array, target: Array, radius: float) -> Array:
    """Return points from the eye to `radius` before the target [m], shape [k, 3].

    Obstacles that touch the target from behind thus block nothing.
    """
    length = float(np.linalg.norm(target - eye))
    count = int(np.clip(np.ceil(length / _STEP), 2, _SAMPLES_MAX))
    return eye + np.linspace(0.0, max(1.0 - radius / max(length, 1e-9), 0.0), count)[:, None] * (target - eye)
