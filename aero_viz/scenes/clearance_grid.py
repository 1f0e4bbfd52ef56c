"""A regular grid of exact distances to the obstacles of a world, and reachability in it, on the CPU.

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import init_warp
from aero_viz.scenes.clearance_kernels import (
    ROUTE_BUCKETS,
    distance_kernel,
    flood_kernel,
    mesh_distance_kernel,
    route_kernel,
)
from aero_viz.scenes.device_worlds import pack_primitives
from aero_viz.scenes.geometry import Primitive
from aero_viz.scenes.primitives import primitive_bounds
from aero_viz.scenes.triangles import TriangleTree
from aero_viz.scenes.world import World

_BAND = 1.5  # [m] below and above start and goal
_POINTS_MAX = 50_000_000  # 250 MB


@dataclass(frozen=True)
class ClearanceGrid:
    """Exact distances to the obstacles at the points of a regular grid.

    The grid covers a band of heights and a rectangle (the region), rounded outward to whole cells. One of its points is
    the start of the world.
    """

    corner: NDArray[np.float64]
    """First point [m], [3], world frame."""
    cell: float
    """Spacing h [m]."""
    distance: NDArray[np.float32]
    """Distance to the nearest surface [m], [X, Y, Z], capped as `measure` says."""
    interior: tuple[slice, slice, slice]
    """Slices of the points that lie within band and region."""

    @classmethod
    def measure(
        cls,
        world: World,
        *,
        cell: float,
        distance_max: float,
        band: tuple[float, float] | None = None,
        region: ArrayLike | None = None,
    ) -> ClearanceGrid:
        """Return the grid of a world.

        Args:
            world: obstacles.
            cell: spacing h [m].
            distance_max: distances are exact up to this value and capped at it [m].
            band: lowest and highest z of the drone's centre [m], widened to start and goal. None is 1.5 m below the
                lower and 1.5 m above the higher of them: a path over all obstacles says nothing about how dense a
                field is.
            region: corners of the x-y rectangle of the drone's centre [m], [2, 2], widened to start and goal. None is
                the rectangle around start, goal and obstacles (bases of cylinders, centres of spheres, boxes without
                the ground, triangles), so that no path leads around the field.

        Raises:
            ValueError: the grid would have more than 50 million points.
        """
        lower, upper = search_box(world, band, region)
        first = np.floor((lower - world.start) / cell + 1e-6).astype(int)
        last = np.ceil((upper - world.start) / cell - 1e-6).astype(int)
        shape = tuple(int(n) for n in last - first + 1)
        if math.prod(shape) > _POINTS_MAX:
            raise ValueError(f"a grid of {shape} points is too large; make the cell larger than {cell:g} m.")
        corner = world.start + first * cell
        init_warp()
        distance = wp.full(shape, distance_max, dtype=float, device="cpu")
        box_lower, box_upper = primitive_bounds(world.cylinders, world.boxes, world.spheres)
        boxes = [wp.array(b, dtype=wp.vec3, device="cpu") for b in (box_lower - distance_max, box_upper + distance_max)]
        primitives = wp.array(pack_primitives(world), dtype=Primitive, device="cpu")
        inputs = [primitives, *boxes, wp.vec3(*corner), cell]
        wp.launch(distance_kernel, len(box_lower), inputs=inputs, outputs=[distance], device="cpu")
        if len(world.triangles):
            tree = TriangleTree(world.triangles)
            inputs = [tree.id, wp.vec3(*corner), cell, distance_max]
            wp.launch(mesh_distance_kernel, shape, inputs=inputs, outputs=[distance], device="cpu")
        begin = np.ceil((lower - corner) / cell - 1e-6).astype(int)
        end = np.floor((upper - corner) / cell + 1e-6).astype(int) + 1
        x, y, z = (slice(int(a), int(b)) for a, b in zip(begin, end, strict=True))
        return cls(corner, cell, np.asarray(distance.numpy(), dtype=np.float32), (x, y, z))

    def cropped(self) -> ClearanceGrid:
        """Return the grid without the points outside band and region."""
        distance = np.ascontiguousarray(self.distance[self.interior])
        x, y, z = (slice(0, n) for n in distance.shape)
        corner = self.corner + self.cell * np.array([part.start for part in self.interior])
        return ClearanceGrid(corner, self.cell, distance, (x, y, z))

    def index(self, point: ArrayLike) -> tuple[int, int, int]:
        """Return the index of the grid point nearest to `point` [m], [3]."""
        index = np.rint((np.asarray(point) - self.corner) / self.cell).astype(int)
        x, y, z = np.clip(index, 0, np.array(self.distance.shape) - 1)
        return int(x), int(y), int(z)

    def reachable(self, start: ArrayLike, *, threshold: float, goal: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return the mask of the points [X, Y, Z] that are 6-connected to `start` by distances of at least `threshold`.

        With a `goal` the search stops there, and the mask is complete only at the goal.

        Args:
            start: [m], [3]; the search begins at the nearest grid point.
            threshold: [m].
            goal: [m], [3].
        """
        x, y, z = self.distance.shape
        first = int(np.ravel_multi_index(self.index(start), (x, y, z)))
        last = -1 if goal is None else int(np.ravel_multi_index(self.index(goal), (x, y, z)))
        distance = wp.array(self.distance.ravel(), dtype=float, device="cpu", copy=False)
        queue = wp.empty(distance.shape, dtype=int, device="cpu")
        reached = wp.zeros(distance.shape, dtype=wp.uint8, device="cpu")
        inputs = [distance, wp.vec3i(x, y, z), threshold, first, last, queue]
        wp.launch(flood_kernel, 1, inputs=inputs, outputs=[reached], device="cpu")
        return reached.numpy().reshape(x, y, z).astype(bool)

    def connects(self, start: ArrayLike, goal: ArrayLike, *, threshold: float) -> bool:
        """Return True if distances of at least `threshold` [m] connect `start` and `goal` [m], both [3]."""
        return bool(self.reachable(start, threshold=threshold, goal=goal)[self.index(goal)])

    def route(self, start: ArrayLike, goal: ArrayLike, *, threshold: float) -> NDArray[np.float64] | None:
        """Return the corners of a short path from `start` to `goal` [n, 3] [m], n >= 2, or None if there is none.

        It is the shortest route over 26-connected points with distances of at least `threshold`, shortened: each corner
        is followed by the last point in its sight. Start and goal themselves need no such distance.

        Args:
            start: [m], [3].
            goal: [m], [3].
            threshold: [m].
        """
        x, y, z = self.distance.shape
        count = x * y * z
        first = int(np.ravel_multi_index(self.index(start), (x, y, z)))
        last = int(np.ravel_multi_index(self.index(goal), (x, y, z)))
        allowed = self.distance.ravel().copy()
        allowed[[first, last]] = np.inf
        parent = wp.full(count, -1, dtype=int, device="cpu")
        workspace = [
            wp.full(ROUTE_BUCKETS, -1, dtype=int, device="cpu"),
            wp.empty(count, dtype=int, device="cpu"),
            wp.empty(count, dtype=int, device="cpu"),
            wp.full(count, 2**30, dtype=int, device="cpu"),
        ]
        distance = wp.array(allowed, dtype=float, device="cpu", copy=False)
        inputs = [distance, wp.vec3i(x, y, z), threshold, first, last, *workspace]
        wp.launch(route_kernel, 1, inputs=inputs, outputs=[parent], device="cpu")
        parents = parent.numpy()
        if parents[last] < 0:
            return None
        route = [last]
        while route[-1] != first:
            route.append(int(parents[route[-1]]))
        points = self.corner + self.cell * np.column_stack(np.unravel_index(route[::-1], (x, y, z)))
        points = np.vstack([start, points[1:-1], goal])
        corners = [0]
        while corners[-1] < len(points) - 1:
            here = corners[-1]
            visible = (
                k for k in range(len(points) - 1, here + 1, -1) if self._sees(points[here], points[k], threshold)
            )
            corners.append(next(visible, here + 1))
        return points[corners]

    def _sees(self, a: NDArray[np.float64], b: NDArray[np.float64], threshold: float) -> bool:
        """Return True if the grid points next to the segment between two points have the required distance."""
        share = np.linspace(0.0, 1.0, max(2, math.ceil(2.0 * float(np.linalg.norm(b - a)) / self.cell)))[1:-1, None]
        index = np.rint((a + share * (b - a) - self.corner) / self.cell).astype(int)
        index = np.clip(index, 0, np.array(self.distance.shape) - 1)
        return bool(np.all(self.distance[tuple(index.T)] >= threshold))


def search_box(
    world: World, band: tuple[float, float] | None = None, region: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and the upper corner [m], [3], of band and region; see `ClearanceGrid.measure`."""
    ends = np.stack([world.start, world.goal])
    low, high = band or (ends[:, 2].min() - _BAND, ends[:, 2].max() + _BAND)
    low, high = min(low, ends[:, 2].min()), max(high, ends[:, 2].max())
    if region is None:
        box_lower, box_upper = primitive_bounds(np.zeros((0, 8)), world.boxes[~world.ground], np.zeros((0, 4)))
        triangles = world.triangles.reshape(-1, 3)
        corners = np.vstack([ends, world.cylinders[:, :3], world.spheres[:, :3], box_lower, box_upper, triangles])[
            :, :2
        ]
    else:
        corners = np.vstack([ends[:, :2], np.asarray(region, dtype=np.float64).reshape(2, 2)])
    return np.array([*corners.min(axis=0), low]), np.array([*corners.max(axis=0), high])
