"""Existence of a path from start to goal for a drone of a given radius, by search in a grid of exact distances.

A grid of points with spacing h represents the space between them in two ways, and the search uses both:

- Points 6-connected with a distance of at least sqrt(r^2 + h^2 / 4) to all obstacles prove a path: on the segment
  between two neighbours p and q, no point c of an obstacle comes closer than r, since a point x of the segment has
  min(|p - c|^2, |q - c|^2) <= |x - c|^2 + h^2 / 4 (Stewart's theorem).
- A path of clearance r stays within sqrt(3) / 2 h of points that are 6-connected and at least r - sqrt(3) / 2 h from
  all obstacles: where those do not connect start and goal, no path exists.

Import it from here, not from `aero_viz.scenes`: it needs Warp.
"""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from aero_viz.scenes.clearance_grid import ClearanceGrid
from aero_viz.scenes.world import World


def is_passable(
    world: World,
    *,
    radius: float = 0.25,
    cell: float = 0.1,
    band: tuple[float, float] | None = None,
    region: ArrayLike | None = None,
) -> bool:
    """Return True if a ball of `radius` [m] can move from start to goal.

    Grids of 4, 2 and 1 `cell` are tried until one proves a path or its absence (see the module). True is always proven,
    except for the last stretch of at most a cell from the nearest grid point to the goal. If no grid decides, the
    answer is False; it can be wrong only where the widest path has a radius between `radius` and about
    `radius` + 0.9 `cell`.

    Args:
        world: obstacles, start and goal.
        radius: r [m].
        cell: h of the finest grid [m].
        band, region: where the drone may fly, see `ClearanceGrid.measure`.

    Raises:
        ValueError: radius or cell is not positive, or the grid would be too large.
    """
    for name, length in (("radius of the drone", radius), ("cell of the grid", cell)):
        if not 0.0 < length < math.inf:
            raise ValueError(f"the {name} is {length:g} m; it must be positive and finite.")
    if world.distance([world.start, world.goal]).min() < radius:
        return False
    for h in (4.0 * cell, 2.0 * cell, cell):
        sufficient, necessary = math.hypot(radius, 0.5 * h), radius - 0.5 * math.sqrt(3.0) * h
        grid = ClearanceGrid.measure(world, cell=h, distance_max=1.01 * sufficient, band=band, region=region)
        if grid.cropped().connects(world.start, world.goal, threshold=sufficient):
            return True
        if not grid.connects(world.start, world.goal, threshold=necessary):
            return False
    return False
