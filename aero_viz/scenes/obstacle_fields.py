"""Seeded scenes of wires, plants and rising ground, on the field of `scenes.field`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import cycle, islice

import numpy as np

from aero_viz.scenes.built_fields import WINDOW, building, window_wall
from aero_viz.scenes.field import (
    AREA,
    GOAL,
    Area,
    Draw,
    Obstacle,
    Rows,
    cylinder,
    field_world,
    leaning_axis,
    place,
    scatter,
    uniform_field,
)
from aero_viz.scenes.world import World

THIN = (0.008, 0.02)
"""Range of the radii of wires and branches [m]."""
WIRE_HEIGHTS = (0.5, 6.0)
"""Range of the heights of the ends of wires [m]."""
BRANCHES = 12
"""Branches of a tree without leaves."""
RISE = 8.0
"""Height of the ground at the goal of the slope [m]."""
_WAVE = 0.8  # [m], largest height of the waves on the slope
_ROOT = 0.3  # [m], depth of a foot on the slope, so that no edge of it hangs in the air
_SLOPE_CELL = 2.0  # [m], edge of the slope's triangles
_SLOPE_AREA = ((2.5, 65.0), (-40.0, 40.0))  # x and y of the slope; it ends where the ground does


def wires(*, seed: int, count: int = 60, ground: bool = True) -> World:
    """Return a world of taut wires, 16 to 40 mm thick, that cross the field in all directions.

    A wire ends at two posts at the border of the field, 0.5 to 6 m above the ground.

    Args:
        seed: same seed, same world.
        count: number of wires.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    return uniform_field(f"wires-{count}-{seed}", partial(wire, rng), count, ground=ground)


def branches(*, seed: int, count: int = 80, ground: bool = True) -> World:
    """Return a world of trees without leaves, each with 12 branches 16 to 40 mm thick.

    Args:
        seed: same seed, same world.
        count: number of trees.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    return uniform_field(f"branches-{count}-{seed}", partial(bare_tree, rng), count, ground=ground)


def crowns(*, seed: int, count: int = 80, ground: bool = True) -> World:
    """Return a world of crowns of trees, 1 to 4.5 m above the ground, on a thin trunk or, every other one, on none.

    Args:
        seed: same seed, same world.
        count: number of crowns.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    draws: list[Draw] = [partial(crown, rng, has_trunk=i % 2 == 0) for i in range(count)]
    return field_world(f"crowns-{count}-{seed}", scatter(draws), ground=ground)


def slope(*, seed: int, count: int = 100, ground: bool = True) -> World:
    """Return a world of trees, as in the forest, on ground that rises by 8 m from start to goal, in waves.

    The goal is 2 m above the ground there, as the start is.

    Args:
        seed: same seed, same world.
        count: number of trees.
        ground: True adds the ground: a box whose top is z = 0, and triangles where it rises.
    """
    rng = np.random.default_rng(seed)
    waves = [(rng.uniform(-np.pi, np.pi), 2.0 * np.pi / rng.uniform(12.0, 20.0), rng.uniform(0.0, 2.0 * np.pi))
             for _ in range(3)]  # fmt: skip

    def elevation(x: Rows, y: Rows) -> Rows:
        """Return the height of the ground [m]."""
        share = np.clip((x - AREA[0][0]) / (AREA[0][1] - AREA[0][0]), 0.0, 1.0)
        height = sum(np.sin(k * (x * np.cos(a) + y * np.sin(a)) + phase) for a, k, phase in waves) / len(waves)
        return RISE * share**2 * (3.0 - 2.0 * share) + _WAVE * 4.0 * share * (1.0 - share) * height

    def draw() -> Obstacle:
        obstacle = tree(rng, 15.0)
        ((x, y, *_),) = obstacle["cylinders"]
        lift = float(elevation(x, y)) - _ROOT
        return {table: rows + lift * (np.arange(rows.shape[1]) == 2) for table, rows in obstacle.items()}

    goal = (*GOAL[:2], GOAL[2] + RISE)
    triangles = _surface(elevation) if ground else np.zeros((0, 9))
    obstacles = scatter([draw] * count, goal=goal)
    return field_world(f"slope-{count}-{seed}", obstacles, ground=ground, goal=goal, triangles=triangles)


def mixture(*, seed: int, count: int = 60, ground: bool = True) -> World:
    """Return a world of wires, trees with and without leaves, crowns, buildings, and walls with a window, in turn.

    Args:
        seed: same seed, same world.
        count: number of obstacles.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)

    def screen() -> Obstacle:
        x, y, _ = place(rng)
        return window_wall(rng, x, (y - 2.0 * WINDOW, y + 2.0 * WINDOW), windows=1, height=4.5)

    kinds: list[Draw] = [
        partial(wire, rng), partial(tree, rng, 15.0), partial(bare_tree, rng),
        partial(crown, rng, has_trunk=False), lambda: building(rng, place(rng)), screen,
    ]  # fmt: skip
    return field_world(f"mixture-{count}-{seed}", scatter(islice(cycle(kinds), count)), ground=ground)


def tree(rng: np.random.Generator, tilt_max: float, area: Area = AREA) -> Obstacle:
    """Return a tree of a forest, whose trunk leans by at most `tilt_max` [deg]."""
    scale = rng.uniform(0.7, 1.3)
    axis = leaning_axis(rng, (0.0, tilt_max))
    height = scale * rng.uniform(5.0, 8.0)
    base = place(rng, area)
    radius = scale * rng.uniform(0.8, 1.4, size=4)
    spread = rng.uniform(-1.0, 1.0, size=(4, 3)) * scale * np.array([0.8, 0.8, 0.6])
    centre = base + height * axis + spread
    centre[:, 2] = np.maximum(centre[:, 2], 3.0 + radius)
    trunk = [*base, *axis, scale * rng.uniform(0.12, 0.3), height]
    return {"cylinders": np.array([trunk]), "spheres": np.column_stack([centre, radius])}


def bare_tree(rng: np.random.Generator) -> Obstacle:
    """Return a tree 4 to 7 m high, with 12 branches, 0.8 to 2.2 m long, from 0.8 m above its foot to its top."""
    base, height = place(rng), rng.uniform(4.0, 7.0)
    top = base + height * leaning_axis(rng, (0.0, 5.0))
    rows = [cylinder(base, top, rng.uniform(0.08, 0.18))]
    for share in rng.uniform(0.8 / height, 1.0, BRANCHES):
        root = base + share * (top - base)
        rows.append(cylinder(root, root + rng.uniform(0.8, 2.2) * leaning_axis(rng, (45.0, 90.0)), rng.uniform(*THIN)))
    return {"cylinders": np.array(rows)}


def crown(rng: np.random.Generator, *, has_trunk: bool) -> Obstacle:
    """Return a crown of six spheres, around a point 1.5 to 4 m above the ground, on a thin trunk or on none."""
    foot = place(rng)
    middle = np.array([foot[0], foot[1], rng.uniform(1.5, 4.0)])
    centre = middle + rng.uniform(-1.0, 1.0, size=(6, 3)) * [0.9, 0.9, 0.5]
    obstacle = {"spheres": np.column_stack([centre, rng.uniform(0.4, 0.8, 6)])}
    trunk = cylinder(foot, middle, rng.uniform(0.03, 0.06))
    return obstacle | ({"cylinders": trunk[None]} if has_trunk else {})


def wire(rng: np.random.Generator) -> Obstacle:
    """Return a wire through a point of the area in any direction, between two posts at the border."""
    middle, heading = place(rng), rng.uniform(0.0, np.pi)
    along = np.array([np.cos(heading), np.sin(heading)])
    limits = (np.array(AREA) - middle[:2, None]) / along[:, None]  # signed distances to the sides [m]
    reach = limits.min(axis=1).max(), limits.max(axis=1).min()
    a, b = (np.array([*(middle[:2] + distance * along), rng.uniform(*WIRE_HEIGHTS)]) for distance in reach)
    posts = [np.array([end[0], end[1], 0.0, 0.0, 0.0, 1.0, 0.06, end[2] + 0.2]) for end in (a, b)]
    return {"cylinders": np.array([cylinder(a, b, rng.uniform(*THIN)), *posts])}


def _surface(elevation: Callable[[Rows, Rows], Rows]) -> Rows:
    """Return the triangles [n, 9] of the ground where it rises, two per cell, seen from above counter-clockwise."""
    x, y = (np.linspace(low, high, round((high - low) / _SLOPE_CELL) + 1) for low, high in _SLOPE_AREA)
    x, y = np.meshgrid(x, y, indexing="ij")
    points = np.stack([x, y, elevation(x, y)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack(corners, axis=2).reshape(-1, 9) for corners in ((a, b, c), (a, c, d))])
