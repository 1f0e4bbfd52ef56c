"""Single solids of a world: found, added, changed and removed. Every edit returns another world."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.scenes.primitives import DISTANCES
from aero_viz.scenes.world import World

KINDS = {"cylinder": "cylinders", "box": "boxes", "sphere": "spheres"}
"""Tables of `World` by the name of a solid."""
_ROUND = {"cylinders": 2, "boxes": 0, "spheres": 3}
"""Number of the sizes of a solid that are one diameter."""
_ROUNDING = 1e-3
"""Largest difference between a size and its text on a page [m]."""
_ON_SURFACE, _FARTHEST, _STEPS = 1e-3, 1000.0, 500


_FIRST_NEW = 1_000_000_000
_new_numbers = itertools.count(_FIRST_NEW)


class ObstacleKey(NamedTuple):
    """Place of a solid in a world."""

    kind: str
    """Table of `World`: "cylinders", "boxes" or "spheres"."""
    row: int

    @property
    def name(self) -> str:
        """Name for the user, such as "box 7", as in `World.nearest`."""
        return f"{next(name for name, kind in KINDS.items() if kind == self.kind)} {self.row}"


class ObstacleId(NamedTuple):
    """Identity of a solid, in every world that was made from one world by `with_obstacle`."""

    kind: str
    """Table of `World`."""
    number: int


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A cylinder, box or sphere: a row of a table of `World`."""

    kind: str
    values: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        """Centre [m], shape [3], world frame."""
        center = self.values[:3].copy()
        return center + 0.5 * self.values[7] * self.values[3:6] if self.kind == "cylinders" else center

    @property
    def size(self) -> NDArray[np.float64]:
        """Width, depth and height along its own axes [m], shape [3]; of a round solid, diameters."""
        if self.kind == "boxes":
            return self.values[3:6].copy()
        diameter = 2.0 * self.values[6 if self.kind == "cylinders" else 3]
        return np.array([diameter, diameter, self.values[7] if self.kind == "cylinders" else diameter])

    @property
    def yaw(self) -> float:
        """Rotation of a box about z [rad]; zero for the others."""
        return float(self.values[6]) if self.kind == "boxes" else 0.0

    def moved(self, center: ArrayLike) -> Obstacle:
        """Return the obstacle with another centre [m], shape [3], world frame."""
        values = self.values.copy()
        values[:3] += np.asarray(center, dtype=np.float64) - self.center
        return Obstacle(self.kind, values)

    def resized(self, size: ArrayLike) -> Obstacle:
        """Return the obstacle with another `size` [m]; a cylinder keeps its base, the others keep their centre.

        Of the sizes that are one diameter, the one that differs from the present one counts.
        """
        values, new, count = self.values.copy(), np.array(size, dtype=np.float64), _ROUND[self.kind]
        differing = new[:count][np.abs(new[:count] - self.size[:count]) > _ROUNDING]
        new[:count] = differing[0] if len(differing) else new[:count]
        if self.kind == "boxes":
            values[3:6] = new
        elif self.kind == "cylinders":
            values[6:8] = 0.5 * new[0], new[2]
        else:
            values[3] = 0.5 * new[0]
        return Obstacle(self.kind, values)

    def turned(self, yaw: float) -> Obstacle:
        """Return a box with another `yaw` [rad], another solid unchanged."""
        yaw = math.remainder(yaw, math.tau)
        return Obstacle(self.kind, np.append(self.values[:6], yaw)) if self.kind == "boxes" else self


def new_obstacle(kind: str, center: ArrayLike, size: ArrayLike) -> Obstacle:
    """Return an upright obstacle of a kind in `KINDS`, with this centre and size [m], each of shape [3]."""
    unit = {"cylinders": [0, 0, -0.5, 0, 0, 1, 0.5, 1], "boxes": [0, 0, 0, 1, 1, 1, 0], "spheres": [0, 0, 0, 0.5]}
    table = KINDS[kind]
    return Obstacle(table, np.array(unit[table], dtype=np.float64)).resized(size).moved(center)


def obstacle_at(world: World, key: ObstacleKey) -> Obstacle | None:
    """Return a solid of a world, None if the world has no such row."""
    table = getattr(world, key.kind)
    return Obstacle(key.kind, table[key.row].copy()) if key.row < len(table) else None


def identify(world: World, key: ObstacleKey) -> ObstacleId:
    """Return the identity of a solid of a world."""
    return ObstacleId(key.kind, int(_numbers(world, key.kind)[key.row]))


def find_obstacle(world: World, identity: ObstacleId) -> ObstacleKey | None:
    """Return the place of a solid in a world; None if it is not there."""
    rows = np.flatnonzero(_numbers(world, identity.kind) == identity.number)
    return ObstacleKey(identity.kind, int(rows[0])) if len(rows) else None


def _numbers(world: World, kind: str) -> NDArray[np.int64]:
    """Return the identity of each row of a table."""
    return world.numbers.get(kind, np.arange(len(getattr(world, kind)), dtype=np.int64))


def with_obstacle(world: World, obstacle: Obstacle | None, key: ObstacleKey | None = None) -> World:
    """Return the world with an obstacle in place of the solid `key`, or in addition; without that solid for None.

    An obstacle that is added or changed is static, even if it replaces a moving one.

    Raises:
        ValueError: a size or a position is not a number that a world can have; names the row.
    """
    if obstacle is None and key is None:
        return world
    kind = key.kind if obstacle is None and key is not None else obstacle.kind  # type: ignore[union-attr]
    numbers, motion = _numbers(world, kind), world.motion
    if len(motion) and kind == "cylinders":
        motion = _with_row(motion, None if obstacle is None else np.zeros(3), key)
    table = _with_row(getattr(world, kind), None if obstacle is None else obstacle.values, key)
    if key is None:
        numbers = np.append(numbers, next(_new_numbers))
    elif obstacle is None:
        numbers = np.delete(numbers, key.row)
    changes: Any = {kind: table, "numbers": {**world.numbers, kind: numbers}, "motion": motion}
    return dataclasses.replace(world, **changes)


def _with_row(
    table: NDArray[np.float64], values: NDArray[np.float64] | None, key: ObstacleKey | None
) -> NDArray[np.float64]:
    """Return a table with values in a row, or in an additional one; without that row for None."""
    if values is None:
        assert key is not None
        return np.delete(table, key.row, 0)
    if key is None:
        return np.vstack([table, values])
    table = table.copy()
    table[key.row] = values
    return table


def added_rows(world: World, kind: str) -> NDArray[np.int64]:
    """Return the rows of a table that `with_obstacle` has added."""
    return np.flatnonzero(_numbers(world, kind) >= _FIRST_NEW)


def pick_obstacle(
    world: World, origin: ArrayLike, direction: ArrayLike, *, ignored: Collection[ObstacleKey] = ()
) -> ObstacleKey | None:
    """Return the first solid on a ray, without the ground; None if it meets none within a kilometre.

    Args:
        world: obstacles.
        origin: start of the ray [m], shape [3].
        direction: unit vector, shape [3].
        ignored: solids that the ray passes through.
    """
    tables = {kind: np.arange(len(getattr(world, kind))) for kind in KINDS.values()}
    tables["boxes"] = np.flatnonzero(~world.ground)
    for key in ignored:
        tables[key.kind] = tables[key.kind][tables[key.kind] != key.row]
    ray, reach = np.asarray(direction, dtype=np.float64), 0.0
    for _ in range(_STEPS):
        point = np.asarray(origin, dtype=np.float64) + reach * ray
        near = [
            (float(distances.min()), ObstacleKey(kind, int(rows[distances.argmin()])))
            for kind, rows in tables.items()
            if len(rows) and len(distances := DISTANCES[kind](point, getattr(world, kind)[rows]))
        ]
        distance, key = min(near, default=(np.inf, None))
        if distance < _ON_SURFACE:
            return key
        reach += distance
        if reach > _FARTHEST:
            break
    return None
