"""The paper's four indoor rooms: seeded, at 0.8 m height, with a goal 3.75 m ahead.

The paper shows the rooms and gives no measures; those here are chosen so that every passage is at least 0.55 m wide,
which a drone of radius 0.25 m can pass.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError
from aero_viz.scenes.world import World

__all__ = ["CLEAR_RADIUS", "double_wall_trap", "pillars", "random_clutter", "wall"]

START = (0.0, 0.0, 0.8)
GOAL = (3.75, 0.0, 0.8)
CLEAR_RADIUS = 0.6
"""Free distance around start and goal [m]."""
LOWER, UPPER = (-1.25, -2.0), (5.0, 2.0)
"""Inner corners of the room, x and y [m]."""
HEIGHT = 2.5
"""Of the room's own walls and of what reaches up to the ceiling where there is none [m]."""
THICKNESS = 0.1
"""Of all walls and of the ceiling [m]."""
_GAP = 0.6  # [m] between two obstacles
_TRIES = 10_000

Rows = NDArray[np.float64]


def pillars(
    *, seed: int, count: int = 6, radius: tuple[float, float] = (0.08, 0.15), ceiling: float | None = None,
    ground: bool = True,
) -> World:  # fmt: skip
    """Return a room with pillars at least 0.6 m apart, the first of them in the straight way.

    Args:
        seed: same seed, same room.
        count: number of pillars.
        radius: range of the radii [m], uniform.
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open above.
        ground: add the floor, a box whose top is z = 0.

    Raises:
        UserError: there is no room for so many.
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
    """Return a room with a wall across the straight way; the wider of the two ways around it is at least 0.9 m wide.

    Args:
        seed: same seed, same room: the wall's place, within 0.3 m of the middle, and its width.
        width: range of the wall's width [m], uniform.
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open above.
        ground: add the floor, a box whose top is z = 0.
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
    """Return a room with two walls from side to side, each with a passage at one end, on opposite sides.

    The passage of the first wall leads in front of the second; the walls reach the ceiling: none can be flown over.

    Args:
        seed: same seed, same room: the side of the first passage, the walls' places and the passages' widths.
        passage: range of the passages' widths [m], uniform.
        spacing: range of the distance between the walls [m], uniform.
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open above.
        ground: add the floor, a box whose top is z = 0.
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
    """Return a room with boxes, leaning poles and balls in the air, seen from above at least 0.6 m apart.

    Args:
        seed: same seed, same room.
        count: number of things; box, pole and ball in turn.
        size: range of the radius around a thing, seen from above [m], uniform.
        ceiling: height of the ceiling, 1.4 m or more; None leaves the room open above.
        ground: add the floor, a box whose top is z = 0.

    Raises:
        UserError: there is no room for so many.
    """
    rng = np.random.default_rng(seed)
    boxes, cylinders, spheres = [], [], []
    for i, (x, y, radius) in enumerate(_spread(rng, count, size, "things")):
        if i % 3 == 0:
            height, aspect = rng.uniform(0.6, 1.8), rng.uniform(0.5, 0.8)
            edges = 2.0 * radius * np.array([aspect, np.sqrt(1.0 - aspect**2)])
            boxes.append([x, y, 0.5 * height, *edges, height, rng.uniform(-np.pi, np.pi)])
        elif i % 3 == 1:
            # From one rim of the disc to the other, so that the pole leans and stays within it.
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


def _spread(rng: np.random.Generator, count: int, radius: tuple[float, float], what: str) -> Rows:
    """Return discs x, y, radius [count, 3] between start and goal, 0.6 m apart, the first in the straight way."""
    discs = np.zeros((0, 3))
    ends = np.array([[*START[:2], CLEAR_RADIUS - _GAP], [*GOAL[:2], CLEAR_RADIUS - _GAP]])
    for _ in range(_TRIES):
        if len(discs) == count:
            return discs
        if len(discs) == 0:
            place = [rng.uniform(1.5, 2.25), rng.uniform(-0.1, 0.1)]
        else:
            place = [rng.uniform(0.4, 3.4), rng.uniform(LOWER[1] + 0.1, UPPER[1] - 0.1)]
        disc = np.array([*place, rng.uniform(*radius)])
        others = np.vstack([ends, discs])
        if np.all(np.hypot(*(others - disc)[:, :2].T) >= others[:, 2] + disc[2] + _GAP):
            discs = np.vstack([discs, disc])
    raise UserError(f"The room holds {len(discs)} {what} with {_GAP:g} m between them, not {count}; ask for fewer.")


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
    # Whoever flies over the walls has left the room.
    bounds = np.array([[x0, y0, -0.5], [x1, y1, height]])
    return World(name, np.array(START), np.array(GOAL), bounds=bounds, **tables)
