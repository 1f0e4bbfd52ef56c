"""The paper's four indoor rooms, seeded, with start and goal 3.75 m apart at a height of 0.8 m.

The paper shows the rooms but gives no dimensions. These are chosen so that every passage is at least 0.55 m wide, which
is enough for a drone of radius 0.25 m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError
from aero_viz.scenes.world import World

START = (0.0, 0.0, 0.8)
GOAL = (3.75, 0.0, 0.8)
CLEAR_RADIUS = 0.6
"""Free distance around start and goal [m]."""
LOWER, UPPER = (-1.25, -2.0), (5.0, 2.0)
"""Inner corners of the room in x and y [m]."""
HEIGHT = 2.5
"""Height of the outer walls, and of full-height obstacles in a room without a ceiling [m]."""
THICKNESS = 0.1
"""Thickness of walls and ceiling [m]."""
_GAP = 0.6  # [m] between obstacles
_ATTEMPTS = 10_000

Rows = NDArray[np.float64]


def pillars(
    *, seed: int, count: int = 6, radius: tuple[float, float] = (0.08, 0.15), ceiling: float | None = None,
    ground: bool = True,
) -> World:  # fmt: skip
    """Return a room with pillars at least 0.6 m apart, the first of them on the direct line from start to goal.

    Args:
        seed: same seed, same room.
        count: number of pillars.
        radius: range of the uniform radii [m].
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open at the top.
        ground: True adds the floor, a box whose top is z = 0.

    Raises:
        UserError: they do not all fit.
    """
    rng = np.random.default_rng(seed)
    height = ceiling or HEIGHT
    discs = _spread(rng, count, radius, "pillars")
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    cylinders = np.column_stack([discs[:, :2], upright, discs[:, 2], np.full(count, height)])
    return _room(f"pillars-{count}-{seed}", ceiling, ground, cylinders=cylinders)


def wall(
    *, seed: int, width: tuple[float, float] = (1.6, 2.2), ceiling: float | None = None, ground: bool = True
) -> World:
    """Return a room with a wall across the direct line; the wider of the passages at its ends is at least 0.9 m wide.

    Args:
        seed: same seed, same room; it determines the position of the wall, within 0.3 m of the centre, and its width.
        width: range of the uniform width of the wall [m].
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open at the top.
        ground: True adds the floor, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    height = ceiling or HEIGHT
    x, y, breadth = rng.uniform(1.5, 2.25), rng.uniform(-0.3, 0.3), rng.uniform(*width)
    boxes = np.array([[x, y, 0.5 * height, THICKNESS, breadth, height, 0.0]])
    return _room(f"wall-{seed}", ceiling, ground, boxes=boxes)


def double_wall_trap(
    *,
    seed: int,
    passage: tuple[float, float] = (0.8, 1.1),
    spacing: tuple[float, float] = (1.2, 1.5),
    ceiling: float | None = 1.6,
    ground: bool = True,
) -> World:
    """Return a room with two walls across it, each with a passage at one end, on opposite sides.

    The passage of the first wall leads to the closed part of the second. The walls reach the ceiling.

    Args:
        seed: same seed, same room; it determines the side of the first passage, the positions of the walls and the
            widths of the passages.
        passage: range of the uniform widths of the passages [m].
        spacing: range of the uniform distance between the walls [m].
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open at the top.
        ground: True adds the floor, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    height = ceiling or HEIGHT
    side = rng.choice([-1.0, 1.0])
    x = rng.uniform(1.0, 1.2) + np.array([0.0, rng.uniform(*spacing)])
    boxes = []
    for place, toward in zip(x, (side, -side), strict=True):
        breadth = UPPER[1] - LOWER[1] - rng.uniform(*passage)
        middle = -toward * 0.5 * (UPPER[1] - LOWER[1] - breadth)
        boxes.append([place, middle, 0.5 * height, THICKNESS, breadth, height, 0.0])
    return _room(f"double_wall_trap-{seed}", ceiling, ground, boxes=np.array(boxes))


def random_clutter(
    *, seed: int, count: int = 9, size: tuple[float, float] = (0.1, 0.22), ceiling: float | None = None,
    ground: bool = True,
) -> World:  # fmt: skip
    """Return a room with boxes, leaning poles and floating balls, horizontally at least 0.6 m apart.

    Args:
        seed: same seed, same room.
        count: number of obstacles: box, pole and ball in turn.
        size: range of the uniform horizontal radius of an obstacle [m].
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open at the top.
        ground: True adds the floor, a box whose top is z = 0.

    Raises:
        UserError: they do not all fit.
    """
    rng = np.random.default_rng(seed)
    boxes, cylinders, spheres = [], [], []
    for i, (x, y, radius) in enumerate(_spread(rng, count, size, "obstacles")):
        if i % 3 == 0:
            height, aspect = rng.uniform(0.6, 1.8), rng.uniform(0.5, 0.8)
            edges = 2.0 * radius * np.array([aspect, np.sqrt(1.0 - aspect**2)])
            boxes.append([x, y, 0.5 * height, *edges, height, rng.uniform(-np.pi, np.pi)])
        elif i % 3 == 1:
            # The pole leans from one rim of its disc to the opposite one.
            thickness, heading = 0.04, rng.uniform(-np.pi, np.pi)
            lean = (radius - thickness) * np.array([np.cos(heading), np.sin(heading)])
            axis = np.array([*(2.0 * lean), 2.0])
            cylinders.append([x - lean[0], y - lean[1], 0.0, *(axis / np.linalg.norm(axis)), thickness, 2.0])
        else:
            spheres.append([x, y, rng.uniform(0.5, 1.4), radius])
    tables = {"boxes": boxes, "cylinders": cylinders, "spheres": spheres}
    return _room(
        f"random_clutter-{count}-{seed}", ceiling, ground, **{key: np.array(rows) for key, rows in tables.items()}
    )


def _spread(rng: np.random.Generator, count: int, radius: tuple[float, float], noun: str) -> Rows:
    """Return discs x, y, radius [count, 3], 0.6 m apart and from start and goal, the first on the direct line."""
    discs = np.zeros((0, 3))
    ends = np.array([[*START[:2], CLEAR_RADIUS - _GAP], [*GOAL[:2], CLEAR_RADIUS - _GAP]])
    for _ in range(_ATTEMPTS):
        if len(discs) == count:
            return discs
        if len(discs) == 0:
            place = [rng.uniform(1.5, 2.25), rng.uniform(-0.1, 0.1)]
        else:
            place = [rng.uniform(0.4, 3.4), rng.uniform(LOWER[1] + 0.1, UPPER[1] - 0.1)]
        disc = np.array([*place, rng.uniform(*radius)])
        placed = np.vstack([ends, discs])
        if np.all(np.hypot(*(placed - disc)[:, :2].T) >= placed[:, 2] + disc[2] + _GAP):
            discs = np.vstack([discs, disc])
    raise UserError(f"The room holds {len(discs)} {noun} with {_GAP:g} m between them, not {count}; ask for fewer.")


def _room(name: str, ceiling: float | None, ground: bool, **tables: Rows) -> World:
    if ceiling is not None and not START[2] + CLEAR_RADIUS <= ceiling < np.inf:
        raise UserError(f"The ceiling is at {ceiling!r} m; it must be at {START[2] + CLEAR_RADIUS:g} m or higher.")
    height = ceiling or HEIGHT
    (x0, y0), (x1, y1) = LOWER, UPPER
    x, y, t = 0.5 * (x0 + x1), 0.5 * (y0 + y1), THICKNESS
    boxes = [
        [x0 - 0.5 * t, y, 0.5 * height, t, y1 - y0 + 2 * t, height, 0.0],
        [x1 + 0.5 * t, y, 0.5 * height, t, y1 - y0 + 2 * t, height, 0.0],
        [x, y0 - 0.5 * t, 0.5 * height, x1 - x0, t, height, 0.0],
        [x, y1 + 0.5 * t, 0.5 * height, x1 - x0, t, height, 0.0],
    ]
    if ground:
        boxes.append([x, y, -0.5, x1 - x0 + 2 * t, y1 - y0 + 2 * t, 1.0, 0.0])
    if ceiling is not None:
        boxes.append([x, y, ceiling + 0.5 * t, x1 - x0 + 2 * t, y1 - y0 + 2 * t, t, 0.0])
    tables["boxes"] = np.vstack([tables.get("boxes", np.zeros((0, 7))).reshape(-1, 7), boxes])
    # A drone above the walls has left the room.
    bounds = np.array([[x0, y0, -0.5], [x1, y1, height]])
    return World(name, np.array(START), np.array(GOAL), bounds=bounds, mission=None, **tables)
