"""The field of outdoor scenes, 40 m x 40 m between a start and a goal 45 m apart, and obstacles scattered on it.

Obstacles are tables of `World` by name, such as {"cylinders": [n, 8]}.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes.primitives import DISTANCES
from aero_viz.scenes.world import World

START = (0.0, 0.0, 2.0)
GOAL = (45.0, 0.0, 2.0)
AREA = ((2.5, 42.5), (-20.0, 20.0))
"""Ranges of x and y in which obstacles stand [m]."""
CLEAR_RADIUS = 2.5
"""Free distance around start and goal [m]."""

Rows = NDArray[np.float64]
Obstacle = Mapping[str, Rows]
"""Rows of the tables of a `World` that make up one obstacle, by table."""
Draw = Callable[[], Obstacle]
Position = tuple[float, float, float]
Area = tuple[tuple[float, float], tuple[float, float]]


def place(rng: np.random.Generator, area: Area = AREA) -> Rows:
    """Return a uniform place of an area at z = 0 [m], [3]."""
    return np.array([rng.uniform(*area[0]), rng.uniform(*area[1]), 0.0])


def ground_box(goal: Position) -> Rows:
    """Return the box [7] of the ground: its top is z = 0, and it extends 20 m or more beyond start, goal and area."""
    return np.array([0.5 * goal[0], 0.0, -0.5, goal[0] + 40.0, 80.0, 1.0, 0.0])


def leaning_axis(rng: np.random.Generator, tilt: tuple[float, float]) -> Rows:
    """Return a unit vector [3] with a uniform angle from the vertical, between two bounds [deg], in any azimuth."""
    angle = np.radians(rng.uniform(*tilt))
    heading = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.sin(angle) * np.cos(heading), np.sin(angle) * np.sin(heading), np.cos(angle)])


def cylinder(base: Rows, tip: Rows, radius: float) -> Rows:
    """Return the row [8] of a cylinder between the centres of its ends [m], [3]."""
    span = tip - base
    length = float(np.linalg.norm(span))
    return np.array([*base, *(span / length), radius, length])


def scatter(draws: Iterable[Draw], *, goal: Position = GOAL) -> list[Obstacle]:
    """Return one obstacle of each draw, drawn again until it is clear of `START` and `goal` [m]."""
    obstacles = []
    for draw in draws:
        obstacle = draw()
        while not _is_clear(obstacle, goal=goal):
            obstacle = draw()
        obstacles.append(obstacle)
    return obstacles


def field_world(
    name: str, obstacles: Iterable[Obstacle], *, ground: bool, goal: Position = GOAL, **options: Rows
) -> World:
    """Return the world of obstacles on the field.

    Args:
        name: of the world.
        obstacles: their tables are joined in this order.
        ground: True adds the box of the ground, after all others.
        goal: [m].
        options: further arguments of `World`.
    """
    rows: dict[str, list[Rows]] = {}
    for obstacle in [*obstacles, {"boxes": ground_box(goal)[None]}] if ground else obstacles:
        for table, part in obstacle.items():
            rows.setdefault(table, []).append(part)
    tables = {table: np.concatenate(parts) for table, parts in rows.items()}
    return World(name, np.array(START), np.array(goal), mission=None, **tables, **options)


def uniform_field(name: str, draw: Draw, count: int, *, ground: bool, goal: Position = GOAL) -> World:
    """Return the world of obstacles of one kind on the field, see `field_world`."""
    return field_world(name, scatter([draw] * count, goal=goal), ground=ground, goal=goal)


def _is_clear(obstacle: Obstacle, *, goal: Position) -> bool:
    """Return True if an obstacle keeps `CLEAR_RADIUS` from `START` and `goal` [m]."""
    # Not a `World` for each obstacle: its checks would take most of the time of making a scene.
    ends = np.array([[START], [goal]])
    return all(np.all(DISTANCES[table](ends, rows) >= CLEAR_RADIUS) for table, rows in obstacle.items())
