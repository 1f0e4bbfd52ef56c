"""Seeded scenes that people built: city blocks, walls with windows, and a hall, on the field of `scenes.field`."""

from __future__ import annotations

import numpy as np

from aero_viz.errors import UserError
from aero_viz.scenes.field import AREA, Obstacle, Rows, field_world
from aero_viz.scenes.world import World

WINDOW = 1.6
"""Width and height of a window [m]."""
WINDOWS = 3
"""Windows in a wall across the field."""
WALLS_HEIGHT = 5.0
"""Height of the walls with windows, above which a drone has left the world [m]."""
WALLS_MAX = 8
"""Largest number of walls with windows: they are at least 2.4 m apart."""
HALL_HEIGHT = 6.0
"""Height of the hall's roof [m]."""
_INSIDE = ((-4.0, 49.0), AREA[1])
"""Ranges of x and y inside the outer walls [m]."""
_THICKNESS = 0.2  # [m], of walls and roof
_SILL = (0.7, 2.2)  # [m], heights of the lower edges of windows
_PIER = 0.5  # [m], smallest breadth of a wall beside a window
_BAY = 5.0  # [m], distance of the hall's pillars before they are displaced


def blocks(*, seed: int, ground: bool = True) -> World:
    """Return a world of city blocks: rows of buildings across the field, with streets between rows and alleys in them.

    Buildings are 4 to 12 m high, streets 2.5 to 4 m wide and alleys 1.5 to 3.5 m. The alleys of two rows are not
    aligned. One lot in ten is empty.

    Args:
        seed: same seed, same world.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    (x_first, x_last), (y_first, y_last) = AREA
    buildings = []
    x = x_first + rng.uniform(0.5, 2.0)
    while x < x_last - 3.0:
        depth = min(rng.uniform(3.0, 5.0), x_last - x)
        y = y_first + rng.uniform(0.0, 3.5)
        while y < y_last - 2.0:
            breadth = min(rng.uniform(3.0, 7.0), y_last - y)
            height = rng.uniform(4.0, 12.0)
            if rng.uniform() > 0.1:
                buildings.append(_block((x, y, 0.0), (x + depth, y + breadth, height)))
            y += breadth + rng.uniform(1.5, 3.5)
        x += depth + rng.uniform(2.5, 4.0)
    return field_world(f"blocks-{seed}", [{"boxes": np.array(buildings)}], ground=ground)


def windows(*, seed: int, count: int = 4, ground: bool = True) -> World:
    """Return a world with walls across it, each with three square windows of 1.6 m, the only ways through.

    Outer walls enclose the field. A drone above them has left the world. Every third of a wall has a window, whose
    lower edge is 0.7 to 2.2 m above the ground.

    Args:
        seed: same seed, same world.
        count: number of walls, at most `WALLS_MAX`.
        ground: True adds the ground, a box whose top is z = 0.

    Raises:
        UserError: there are too many walls.
    """
    if count > WALLS_MAX:
        raise UserError(f"The field holds {WALLS_MAX} walls with windows, not {count}; ask for fewer.")
    rng = np.random.default_rng(seed)
    first, last = AREA[0][0] + _THICKNESS, AREA[0][1] - _THICKNESS
    spacing = (last - first) / max(count, 1)
    places = first + spacing * (np.arange(count) + rng.uniform(0.25, 0.75, count))
    walls = [window_wall(rng, x, AREA[1], windows=WINDOWS, height=WALLS_HEIGHT) for x in places]
    return field_world(
        f"windows-{count}-{seed}", [*walls, _outer_walls(WALLS_HEIGHT)], ground=ground, bounds=_inside(WALLS_HEIGHT)
    )


def window_wall(rng: np.random.Generator, x: float, y: tuple[float, float], *, windows: int, height: float) -> Obstacle:
    """Return a wall across the x axis with square windows of 1.6 m, one in each of equal parts.

    Args:
        rng: of the windows' places.
        x: of its middle plane [m].
        y: range [m].
        windows: number of them.
        height: [m].
    """
    edges = np.linspace(*y, windows + 1)
    left = rng.uniform(edges[:-1] + _PIER, edges[1:] - _PIER - WINDOW)
    sill = rng.uniform(*_SILL, windows)
    near, far = x - 0.5 * _THICKNESS, x + 0.5 * _THICKNESS
    boxes = []
    for a, low in zip(left, sill, strict=True):
        boxes.append(_block((near, a, 0.0), (far, a + WINDOW, low)))
        boxes.append(_block((near, a, low + WINDOW), (far, a + WINDOW, height)))
    for a, b in zip([y[0], *(left + WINDOW)], [*left, y[1]], strict=True):
        boxes.append(_block((near, a, 0.0), (far, b, height)))
    return {"boxes": np.array(boxes)}


def hall(*, seed: int, ground: bool = True) -> World:
    """Return a hall with pillars, round or square, and level beams between them at heights of 1 to 5 m.

    The hall is 53 m x 40 m and has a roof at 6 m. Its 64 pillars are 0.4 to 0.8 m wide and stand within 1.2 m of a grid
    of 5 m. Half of all neighbours along the grid are connected by a beam, 0.2 to 0.4 m wide and high.

    Args:
        seed: same seed, same world.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    x, y = (np.arange(low + 0.5 * _BAY, high, _BAY) for low, high in AREA)
    feet = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    feet += rng.uniform(-1.2, 1.2, feet.shape)
    parts = [_pillar(rng, foot) for foot in feet.reshape(-1, 2)]
    pairs = [*zip(feet[:-1].reshape(-1, 2), feet[1:].reshape(-1, 2), strict=True),
             *zip(feet[:, :-1].reshape(-1, 2), feet[:, 1:].reshape(-1, 2), strict=True)]  # fmt: skip
    parts += [_beam(rng, a, b) for a, b in pairs if rng.uniform() < 0.5]
    (x0, x1), (y0, y1) = _INSIDE
    roof = {"boxes": np.array([_block((x0, y0, HALL_HEIGHT), (x1, y1, HALL_HEIGHT + _THICKNESS))])}
    return field_world(
        f"hall-{seed}",
        [*parts, _outer_walls(HALL_HEIGHT), roof],
        ground=ground,
        bounds=_inside(HALL_HEIGHT),
    )


def building(rng: np.random.Generator, place: Rows) -> Obstacle:
    """Return a building of 2 to 4 m x 2 to 4 m, 3 to 8 m high and turned by any angle, at a place [m], [3]."""
    size = rng.uniform([2.0, 2.0, 3.0], [4.0, 4.0, 8.0])
    return {"boxes": np.array([[*place[:2], 0.5 * size[2], *size, rng.uniform(-np.pi, np.pi)]])}


def _pillar(rng: np.random.Generator, foot: Rows) -> Obstacle:
    width = rng.uniform(0.4, 0.8)
    if rng.uniform() < 0.5:
        return {"cylinders": np.array([[*foot, 0.0, 0.0, 0.0, 1.0, 0.5 * width, HALL_HEIGHT]])}
    return {"boxes": np.array([[*foot, 0.5 * HALL_HEIGHT, width, width, HALL_HEIGHT, 0.0]])}


def _beam(rng: np.random.Generator, a: Rows, b: Rows) -> Obstacle:
    (dx, dy), width = b - a, rng.uniform(0.2, 0.4)
    middle = 0.5 * (a + b)
    return {"boxes": np.array([[*middle, rng.uniform(1.0, 5.0), np.hypot(dx, dy), width, width, np.arctan2(dy, dx)]])}


def _outer_walls(height: float) -> Obstacle:
    (x0, x1), (y0, y1), t = *_INSIDE, _THICKNESS
    sides = [((x0 - t, y0 - t), (x0, y1 + t)), ((x1, y0 - t), (x1 + t, y1 + t)),
             ((x0, y0 - t), (x1, y0)), ((x0, y1), (x1, y1 + t))]  # fmt: skip
    return {"boxes": np.array([_block((*low, 0.0), (*high, height)) for low, high in sides])}


def _inside(height: float) -> Rows:
    (x0, x1), (y0, y1) = _INSIDE
    return np.array([[x0, y0, -0.5], [x1, y1, height]])


def _block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Rows:
    """Return the row [7] of a box between two corners [m]."""
    lower, upper = np.array(low), np.array(high)
    return np.array([*(0.5 * (lower + upper)), *(upper - lower), 0.0])
