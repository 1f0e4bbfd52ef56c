"""Whether a drone can fly from start to goal at all: a search in a grid of exact distances.

A grid of points with spacing h stands for the space between them in two ways, and the search uses both:

- Points 6-connected with a distance of at least sqrt(r^2 + h^2 / 4) to all obstacles prove a path: on the segment
  between two neighbours p and q, no obstacle's point c comes closer than r, since a point x of the segment has
  min(|p - c|^2, |q - c|^2) <= |x - c|^2 + h^2 / 4 (Stewart's theorem).
- A path of clearance r stays within sqrt(3) / 2 h of points that are 6-connected and at least r - sqrt(3) / 2 h from
  all obstacles: where those do not connect start and goal, no path exists.

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import quieten
from aero_viz.scenes.geometry import Primitive, device_primitives, primitive_distance
from aero_viz.scenes.triangles import TriangleTree, mesh_distance
from aero_viz.scenes.world import World, primitive_bounds

__all__ = ["ClearanceGrid", "is_passable", "widest_radius"]

wp.set_module_options({"enable_backward": False})

_BAND = 1.5  # [m] below and above start and goal
_POINTS = 50_000_000  # points of a grid at most: 250 MB
_BISECTIONS = 10


@wp.kernel
def distance_kernel(
    primitives: wp.array(dtype=Primitive),
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    corner: wp.vec3,
    cell: float,
    distance: wp.array3d(dtype=float),
):
    """Lower the distances around each primitive; lower, upper: box around it that it can affect [m]."""
    i = wp.tid()
    first = (lower[i] - corner) / cell
    last = (upper[i] - corner) / cell
    x_end = wp.min(int(wp.floor(last[0])) + 1, distance.shape[0])
    y_end = wp.min(int(wp.floor(last[1])) + 1, distance.shape[1])
    z_end = wp.min(int(wp.floor(last[2])) + 1, distance.shape[2])
    for x in range(wp.max(int(wp.ceil(first[0])), 0), x_end):
        for y in range(wp.max(int(wp.ceil(first[1])), 0), y_end):
            for z in range(wp.max(int(wp.ceil(first[2])), 0), z_end):
                point = corner + cell * wp.vec3(float(x), float(y), float(z))
                wp.atomic_min(distance, x, y, z, primitive_distance(primitives[i], point))


@wp.kernel
def mesh_distance_kernel(
    mesh: wp.uint64, corner: wp.vec3, cell: float, reach: float, distance: wp.array3d(dtype=float)
):
    """Lower the distances to those to triangles."""
    x, y, z = wp.tid()
    point = corner + cell * wp.vec3(float(x), float(y), float(z))
    distance[x, y, z] = wp.min(distance[x, y, z], mesh_distance(mesh, point, reach))


@wp.kernel
def flood_kernel(
    distance: wp.array(dtype=float),
    shape: wp.vec3i,
    threshold: float,
    start: int,
    goal: int,
    queue: wp.array(dtype=int),
    reached: wp.array(dtype=wp.uint8),
):
    """Breadth-first search by one thread, from start until goal is reached or nothing is left."""
    head = int(0)
    tail = int(0)
    if distance[start] >= threshold:
        queue[0] = start
        reached[start] = wp.uint8(1)
        tail = 1
    while head < tail:
        here = queue[head]
        head += 1
        z = here % shape[2]
        y = here // shape[2] % shape[1]
        x = here // (shape[2] * shape[1])
        for k in range(6):
            there = here
            if k == 0 and x > 0:
                there = here - shape[2] * shape[1]
            elif k == 1 and x < shape[0] - 1:
                there = here + shape[2] * shape[1]
            elif k == 2 and y > 0:
                there = here - shape[2]
            elif k == 3 and y < shape[1] - 1:
                there = here + shape[2]
            elif k == 4 and z > 0:
                there = here - 1
            elif k == 5 and z < shape[2] - 1:
                there = here + 1
            if reached[there] == wp.uint8(0) and distance[there] >= threshold:
                reached[there] = wp.uint8(1)
                queue[tail] = there
                tail += 1
                if there == goal:
                    head = tail
                    break


@dataclass(frozen=True)
class ClearanceGrid:
    """Exact distances to the obstacles on a regular grid, and searches in it, on the CPU.

    The grid covers band and region, rounded outward to whole cells; one of its points is the world's start.
    """

    corner: NDArray[np.float64]
    """First point [m], shape [3], world frame."""
    cell: float
    """h [m]."""
    distance: NDArray[np.float32]
    """Distance to the nearest surface [m], shape [X, Y, Z], `reach` where it is farther."""
    reach: float
    """[m]"""
    inside: tuple[slice, slice, slice]
    """The points that lie within band and region."""

    @classmethod
    def of(
        cls,
        world: World,
        *,
        cell: float,
        reach: float,
        band: tuple[float, float] | None = None,
        region: ArrayLike | None = None,
    ) -> ClearanceGrid:
        """Return the grid of a world.

        Args:
            world: obstacles.
            cell: h [m].
            reach: distances are exact up to here [m].
            band: lowest and highest z of the drone's centre, widened to start and goal [m]; None is 1.5 m below the
                lower and 1.5 m above the higher of them: flying over everything is no answer to how dense a field is.
            region: corners of the x-y rectangle of the drone's centre, widened to start and goal [m], shape [2, 2];
                None is the rectangle around start, goal and obstacles (bases of cylinders, centres of spheres, boxes
                without the ground, triangles), so that nobody flies around the field.

        Raises:
            ValueError: the grid would have more than 50 million points.
        """
        lower, upper = _search_box(world, band, region)
        first = np.floor((lower - world.start) / cell + 1e-6).astype(int)
        last = np.ceil((upper - world.start) / cell - 1e-6).astype(int)
        shape = tuple(int(n) for n in last - first + 1)
        if math.prod(shape) > _POINTS:
            raise ValueError(f"a grid of {shape} points is too large; make the cell larger than {cell:g} m.")
        corner = world.start + first * cell
        quieten()
        distance = wp.full(shape, reach, dtype=float, device="cpu")
        bounds = primitive_bounds(world.cylinders, world.boxes, world.spheres)
        around = [wp.array(b, dtype=wp.vec3, device="cpu") for b in (bounds[0] - reach, bounds[1] + reach)]
        inputs = [device_primitives(world), *around, wp.vec3(*corner), cell]
        wp.launch(distance_kernel, len(bounds[0]), inputs, [distance], device="cpu")
        if len(world.triangles):
            tree = TriangleTree(world.triangles)
            inputs = [tree.id, wp.vec3(*corner), cell, reach]
            wp.launch(mesh_distance_kernel, shape, inputs, [distance], device="cpu")
        begin = np.ceil((lower - corner) / cell - 1e-6).astype(int)
        end = np.floor((upper - corner) / cell + 1e-6).astype(int) + 1
        x, y, z = (slice(int(a), int(b)) for a, b in zip(begin, end, strict=True))
        return cls(corner, cell, distance.numpy(), reach, (x, y, z))

    def cut(self) -> ClearanceGrid:
        """Return the grid without the points outside band and region."""
        begin = [part.start for part in self.inside]
        distance = np.ascontiguousarray(self.distance[self.inside])
        x, y, z = (slice(0, n) for n in distance.shape)
        return ClearanceGrid(self.corner + self.cell * np.array(begin), self.cell, distance, self.reach, (x, y, z))

    def index(self, point: ArrayLike) -> tuple[int, int, int]:
        """Return the index of the grid's nearest point to `point` [m], shape [3]."""
        index = np.rint((np.asarray(point) - self.corner) / self.cell).astype(int)
        x, y, z = np.clip(index, 0, np.array(self.distance.shape) - 1)
        return int(x), int(y), int(z)

    def reached(self, start: ArrayLike, *, threshold: float, goal: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return which points are 6-connected with the one at `start` [m] by distances of at least `threshold` [m].

        With a `goal` [m] the search ends there and only the answer at the goal is complete. Shape [X, Y, Z].
        """
        shape = self.distance.shape
        begin = int(np.ravel_multi_index(self.index(start), shape))
        end = -1 if goal is None else int(np.ravel_multi_index(self.index(goal), shape))
        distance = wp.array(self.distance.ravel(), dtype=float, device="cpu", copy=False)
        queue = wp.empty(distance.shape, dtype=int, device="cpu")
        reached = wp.zeros(distance.shape, dtype=wp.uint8, device="cpu")
        inputs = [distance, wp.vec3i(*shape), threshold, begin, end, queue]
        wp.launch(flood_kernel, 1, inputs, [reached], device="cpu")
        return reached.numpy().reshape(shape).astype(bool)

    def connects(self, start: ArrayLike, goal: ArrayLike, *, threshold: float) -> bool:
        """Return whether distances of at least `threshold` [m] connect the points at `start` and `goal` [m]."""
        return bool(self.reached(start, threshold=threshold, goal=goal)[self.index(goal)])


def is_passable(
    world: World,
    *,
    radius: float = 0.25,
    cell: float = 0.1,
    band: tuple[float, float] | None = None,
    region: ArrayLike | None = None,
) -> bool:
    """Return whether a ball of `radius` [m] can move from start to goal.

    Grids of 4, 2 and 1 `cell` are tried until one proves a path or its absence (see the module). True is always proven,
    apart from the last bit of the way, at most a cell, from the grid's nearest point to the goal. What no grid decides
    is False: it may be wrong only where the widest path has a radius between `radius` and about `radius` + 0.9 `cell`.

    Args:
        world: obstacles, start and goal.
        radius: r [m].
        cell: h of the finest grid [m].
        band, region: where the drone may fly, see `ClearanceGrid.of`.

    Raises:
        ValueError: radius or cell is not positive, or the grid would be too large.
    """
    if not (0.0 < radius < math.inf and 0.0 < cell < math.inf):
        raise ValueError(f"radius is {radius!r} and cell {cell!r}; both must be positive and finite.")
    if world.distance([world.start, world.goal]).min() < radius:
        return False
    for h in (4.0 * cell, 2.0 * cell, cell):
        enough, least = math.hypot(radius, 0.5 * h), radius - 0.5 * math.sqrt(3.0) * h
        grid = ClearanceGrid.of(world, cell=h, reach=1.01 * enough, band=band, region=region)
        if grid.cut().connects(world.start, world.goal, threshold=enough):
            return True
        if not grid.connects(world.start, world.goal, threshold=least):
            return False
    return False


def widest_radius(
    world: World,
    *,
    cell: float = 0.1,
    limit: float = 1.5,
    band: tuple[float, float] | None = None,
    region: ArrayLike | None = None,
) -> float:
    """Return the radius of the largest ball proven to move from start to goal [m]; 0 where none is.

    It is at most the true one, and less by at most about 0.9 `cell`, and `limit` [m] where it would be larger. The
    arguments are those of `is_passable`.
    """
    limit = min(limit, float(world.distance([world.start, world.goal]).min()))
    grid = ClearanceGrid.of(world, cell=cell, reach=1.01 * math.hypot(max(limit, 0.0), 0.5 * cell), band=band,
                            region=region).cut()  # fmt: skip

    def is_proven(radius: float) -> bool:
        return grid.connects(world.start, world.goal, threshold=math.hypot(radius, 0.5 * cell))

    if limit <= 0.0 or not is_proven(0.0):
        return 0.0
    if is_proven(limit):
        return limit
    low, high = 0.0, limit
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_proven(middle) else (low, middle)
    return low


def _search_box(
    world: World, band: tuple[float, float] | None, region: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    ends = np.stack([world.start, world.goal])
    low, high = band or (ends[:, 2].min() - _BAND, ends[:, 2].max() + _BAND)
    low, high = min(low, ends[:, 2].min()), max(high, ends[:, 2].max())
    if region is None:
        box_lower, box_upper = primitive_bounds(np.zeros((0, 8)), world.boxes[~world.ground], np.zeros((0, 4)))
        corners = [ends, world.cylinders[:, :3], world.spheres[:, :3], box_lower, box_upper]
        corners.append(world.triangles.reshape(-1, 3))
        corners = np.vstack(corners)[:, :2]
    else:
        corners = np.vstack([ends[:, :2], np.asarray(region, dtype=np.float64).reshape(2, 2)])
    return np.array([*corners.min(axis=0), low]), np.array([*corners.max(axis=0), high])
