"""Seeded fields of trunks, trees and pillars, and the registry of all scenes."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from aero_viz.errors import UserError
from aero_viz.registry import Registry
from aero_viz.scenes import built_fields, obstacle_fields, rooms
from aero_viz.scenes.course import course
from aero_viz.scenes.field import (
    AREA,
    CLEAR_RADIUS,
    GOAL,
    START,
    Obstacle,
    field_world,
    leaning_axis,
    place,
    uniform_field,
)
from aero_viz.scenes.obstacle_fields import tree
from aero_viz.scenes.world import World

COUNT_MAX = 20_000
"""Largest number of obstacles; more take minutes to place and unbounded memory."""


def forest(*, seed: int, count: int = 100, tilt_max: float = 15.0, ground: bool = True) -> World:
    """Return a forest of trees with tilted trunks and canopies of spheres.

    A tree of scale s, uniform in [0.7, 1.3], has a trunk of radius 0.12 to 0.3 m times s and height 5 to 8 m times s,
    and four canopy spheres of radius 0.8 to 1.4 m times s near its top. No canopy reaches below 3 m, so that a drone at
    2 m flies among trunks.

    Args:
        seed: same seed, same forest.
        count: number of trees.
        tilt_max: largest angle between a trunk and the vertical [deg]; the angle is uniform from 0.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    return uniform_field(f"forest-{count}-{seed}", partial(tree, rng, tilt_max), count, ground=ground)


def long_forest(*, seed: int, count: int = 200, tilt_max: float = 15.0, ground: bool = True) -> World:
    """Return a forest as `forest` has it, 200 m long and 40 m wide, for fast flights.

    Args:
        seed: same seed, same forest.
        count: number of trees.
        tilt_max: largest angle between a trunk and the vertical [deg]; the angle is uniform from 0.
        ground: True adds the ground, a box whose top is z = 0.
    """
    draw = partial(tree, np.random.default_rng(seed), tilt_max, ((2.5, 202.5), AREA[1]))
    return uniform_field(f"long_forest-{count}-{seed}", draw, count, ground=ground, goal=(205.0, 0.0, 2.0))


def verticals(
    *, seed: int, count: int = 1000, width: tuple[float, float] = (0.4, 1.1), height: float = 6.0, ground: bool = True
) -> World:
    """Return a world of vertical cylinders.

    Args:
        seed: same seed, same world.
        count: number of cylinders.
        width: range of the uniform diameters [m].
        height: height of every cylinder [m].
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)

    def draw() -> Obstacle:
        return {"cylinders": np.array([[*place(rng), 0.0, 0.0, 1.0, 0.5 * rng.uniform(*width), height]])}

    return uniform_field(f"verticals-{count}-{seed}", draw, count, ground=ground)


def inclines(
    *,
    seed: int,
    count: int = 800,
    tilt_max: float = 30.0,
    radius: tuple[float, float] = (0.06, 0.3),
    height: float = 10.0,
    ground: bool = True,
) -> World:
    """Return a world of cylinders that stand on z = 0 and lean in all directions.

    Args:
        seed: same seed, same world.
        count: number of cylinders.
        tilt_max: largest angle between a cylinder and the vertical [deg]; the angle is uniform from 0.
        radius: range of the uniform radii [m].
        height: length of every cylinder [m].
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)

    def draw() -> Obstacle:
        return {
            "cylinders": np.array([[*place(rng), *leaning_axis(rng, (0.0, tilt_max)), rng.uniform(*radius), height]])
        }

    return uniform_field(f"inclines-{count}-{seed}", draw, count, ground=ground)


def density(
    *,
    seed: int,
    count: int = 600,
    width: tuple[float, float] = (0.4, 1.1),
    height: tuple[float, float] = (1.0, 6.0),
    ground: bool = True,
) -> World:
    """Return a world of vertical cylinders of random heights, for benchmarks over the number of obstacles.

    Positions and widths depend on the seed only: worlds with random and with fixed heights share them.

    Args:
        seed: same seed, same world.
        count: number of cylinders, 200 to 1000 in the paper.
        width: range of the uniform diameters [m].
        height: range of the uniform heights [m]; (6, 6) is the fixed height of `density-6m`.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)

    def draw() -> Obstacle:
        radius = 0.5 * rng.uniform(*width)
        return {"cylinders": np.array([[*place(rng), 0.0, 0.0, 1.0, radius, rng.uniform(*height)]])}

    kind = f"density-{height[0]:g}m" if height[0] == height[1] else "density"
    return uniform_field(f"{kind}-{count}-{seed}", draw, count, ground=ground)


def moving(*, seed: int, count: int = 40, speed: tuple[float, float] = (0.5, 2.0), ground: bool = True) -> World:
    """Return a world of vertical pillars, 0.4 to 1.1 m wide and 6 m high, that move back and forth over 5 to 15 m.

    Args:
        seed: same seed, same world.
        count: number of pillars.
        speed: range of the uniform speeds [m/s].
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    pillars, motion = [], []
    while len(pillars) < count:
        pillar = np.concatenate([place(rng), [0.0, 0.0, 1.0], [0.5 * rng.uniform(0.4, 1.1), 6.0]])
        heading, span = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(5.0, 15.0)
        direction = np.array([np.cos(heading), np.sin(heading)])
        ends = np.array([START[:2], GOAL[:2]]) - pillar[:2]
        nearest = np.clip(ends @ direction, 0.0, span)[:, None] * direction
        if np.linalg.norm(ends - nearest, axis=1).min() >= CLEAR_RADIUS + pillar[6]:
            pillars.append(pillar)
            motion.append([*rng.uniform(*speed) * direction, span])
    obstacles = [{"cylinders": np.reshape(pillars, (-1, 8))}]
    kind = "moving" if speed[1] <= 2.0 else "fast_moving"
    return field_world(f"{kind}-{count}-{seed}", obstacles, ground=ground, motion=np.reshape(motion, (-1, 3)))


@dataclass(frozen=True)
class SceneKind:
    """Entry of the scene registry."""

    description: str
    """Sentences for the user: the obstacles, and how dense they are."""
    generate: Callable[..., World]
    """Function of seed, ground and, if `counted`, count."""
    clear_radius: float = CLEAR_RADIUS
    """Free distance around start and goal, apart from the ground [m]."""
    counted: bool = True
    """True if the number of obstacles can be chosen."""


def _accept(name: str, found: Any) -> SceneKind:
    """Return a `SceneKind`, or that of a function, which is described by the first line of its docstring."""
    if isinstance(found, SceneKind):
        return found
    try:
        defaults = {name: parameter.default for name, parameter in inspect.signature(found).parameters.items()}
    except (TypeError, ValueError):
        defaults = {}
    if not {"seed", "ground"} <= set(defaults):
        raise UserError(f"{name} is not a scene; give a function of seed, ground and, with a default, count.")
    description = (inspect.getdoc(found) or name).partition("\n")[0]
    return SceneKind(description, found, counted=isinstance(defaults.get("count"), int))


_room = partial(SceneKind, clear_radius=rooms.CLEAR_RADIUS)
_SHIPPED: dict[str, SceneKind | str] = {
    "forest": SceneKind("100 randomly scaled and tilted trees on 40 m x 40 m.", forest),
    "long_forest": SceneKind("200 trees of the forest on 200 m x 40 m, for fast flights.", long_forest),
    "course": SceneKind(
        "12 gates of 2.4 m in a winding row through a forest, to be passed in order.", course, counted=False
    ),
    "verticals": SceneKind("1000 vertical cylinders, 6 m high, 0.4 to 1.1 m wide. Extremely dense.", verticals),
    "inclines": SceneKind("800 cylinders, 10 m long, inclined by up to 30 degrees. Dense.", inclines),
    "density": SceneKind("600 vertical cylinders, 1 to 6 m high, 0.4 to 1.1 m wide. Dense.", density),
    "density-6m": SceneKind("The cylinders of density, all 6 m high. Very dense.", partial(density, height=(6.0, 6.0))),
    "moving": SceneKind("40 pillars, 0.4 to 1.1 m wide, that move back and forth at 0.5 to 2 m/s.", moving),
    "fast_moving": SceneKind("20 such pillars, at 0.5 to 6 m/s.", partial(moving, count=20, speed=(0.5, 6.0))),
    "wires": SceneKind(
        "60 taut wires, 16 to 40 mm thick, criss-cross at heights of 0.5 to 6 m.", obstacle_fields.wires
    ),
    "branches": SceneKind("80 bare trees, each with 12 branches 16 to 40 mm thick.", obstacle_fields.branches),
    "crowns": SceneKind(
        "80 crowns of trees at the height of the drone, every other one without a trunk.", obstacle_fields.crowns
    ),
    "blocks": SceneKind("City blocks, 4 to 12 m high, with streets and alleys.", built_fields.blocks, counted=False),
    "windows": SceneKind("4 walls across the field, each with three windows of 1.6 m.", built_fields.windows),
    "hall": SceneKind("A hall with pillars and beams under a roof at 6 m.", built_fields.hall, counted=False),
    "slope": SceneKind("100 trees on ground that rises by 8 m.", obstacle_fields.slope),
    "mixture": SceneKind(
        "60 obstacles of many kinds: wires, trees, crowns, buildings, windows.", obstacle_fields.mixture
    ),
    "pillars": _room("A room with 6 pillars; the goal is 3.75 m ahead at 0.8 m.", rooms.pillars),
    "wall": _room("A room with a wall across the direct line, open at both ends.", rooms.wall, counted=False),
    "double_wall_trap": _room(
        "A room with two walls whose passages are on opposite sides, under a low ceiling.",
        rooms.double_wall_trap,
        counted=False,
    ),
    "random_clutter": _room("A room cluttered with 9 boxes, poles and balls.", rooms.random_clutter),
}
SCENES: Registry[SceneKind] = Registry(
    "scene", "aero_viz.scenes", _SHIPPED, _accept, others="the path of a world's file"
)
"""All scenes by name."""


def scene(name: str, *, seed: int = 0, count: int | None = None, ground: bool = True) -> World:
    """Return a scene of the registry `SCENES`.

    Args:
        name: key of the registry.
        seed: same seed, same world.
        count: number of obstacles; None is the default of the scene.
        ground: True adds the ground.

    Raises:
        UserError: there is no such scene, the seed is negative, or the count is out of range or cannot be chosen.
    """
    kind = SCENES.known(name)
    if seed < 0:
        raise UserError(f"The seed of the scene {name!r} is {seed}; it must be 0 or more.")
    if count is not None and count < 0:
        raise UserError(f"The number of obstacles of the scene {name!r} is {count}; it must be 0 or more.")
    if count is not None and count > COUNT_MAX:
        raise UserError(f"The number of obstacles of the scene {name!r} is {count}; it must be at most {COUNT_MAX}.")
    if count is not None and not kind.counted:
        raise UserError(f"The number of obstacles of the scene {name!r} is fixed; leave the count out.")
    options = {} if count is None else {"count": count}
    return kind.generate(seed=seed, ground=ground, **options)
