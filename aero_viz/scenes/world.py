"""Worlds of cylinders, boxes, spheres and triangles, with a start and a goal; exact distances; JSON on disk."""

from __future__ import annotations

import json
import reprlib
import sys
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config.parameter import did_you_mean
from aero_viz.errors import UserError
from aero_viz.scenes.mesh import Mesh, to_meshes

if TYPE_CHECKING:
    from aero_viz.scenes.triangles import TriangleTree

__all__ = ["World", "primitive_bounds"]

_TABLES = {
    "cylinders": "bx, by, bz, ax, ay, az, radius, height",
    "boxes": "cx, cy, cz, sx, sy, sz, yaw",
    "spheres": "x, y, z, radius",
    "triangles": "x1, y1, z1, x2, y2, z2, x3, y3, z3",
}
_BOUNDS_MARGIN = 10.0  # generous: leaving the derived bounds means that the drone flew away, not that it cut a corner
_REACH = 100_000.0  # [m]; farther from the origin, single precision has no centimetres left
_LARGEST = 100_000.0  # [m]
_CHUNK = 2_000_000  # point-primitive pairs handled at once by `World.distance`


@dataclass(frozen=True, eq=False)
class World:
    """Solid primitives and surfaces, a start and a goal; metres and radians, z up. Arrays are read-only float64.

    Args:
        name: shown to the user.
        start: first position of the drone, shape [3].
        goal: where to fly, shape [3].
        cylinders: base centre b, unit axis a, radius, height, shape [n, 8]; the solid spans b to b + height a.
        boxes: centre, edge lengths, yaw about z, shape [n, 7].
        spheres: centre, radius, shape [n, 4].
        bounds: lower and upper corner of the air space, shape [2, 3]; None means everything above plus 10 m each way.
        triangles: corners of each, shape [n, 9]: a surface, seen and hit from both sides, that has no inside.

    Raises:
        ValueError: a number is missing, not finite or impossible; names key and row.
    """

    name: str
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    cylinders: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 8)))
    boxes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 7)))
    spheres: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    bounds: NDArray[np.float64] = None  # type: ignore[assignment]
    triangles: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 9)))

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ValueError(f'"name" is {_shown(self.name)}; it must be a text.')
        for key in ("start", "goal"):
            place = _row(getattr(self, key), 3, f'"{key}"', "x, y, z")
            _check_ranges(place[None], f'"{key}"', "x, y, z")
            _store(self, key, place)
        for key, columns in _TABLES.items():
            table = _table(getattr(self, key), key, columns)
            _check_ranges(table, f'"{key}" row {{}}', columns)
            if key == "cylinders":
                _normalise_axes(table)
            _store(self, key, table)
        if self.bounds is None:
            _store(self, "bounds", self._derived_bounds())
            return
        corners = _sequence(self.bounds, '"bounds"', "two corners")
        if len(corners) != 2:
            raise ValueError(f'"bounds" has {len(corners)} rows; it must be two corners, the lower and the upper.')
        corners = np.stack([_row(corner, 3, f'"bounds" row {i}', "x, y, z") for i, corner in enumerate(corners)])
        if not np.all(corners[0] < corners[1]):
            raise ValueError('"bounds" row 0 must be less than row 1 in x, y and z.')
        _store(self, "bounds", corners)

    @classmethod
    def from_dict(cls, content: Any) -> World:
        """Return the world described by `content`, the form of the JSON file.

        Raises:
            ValueError: a key is missing or unknown, or see the class.
        """
        known = ("name", "start", "goal", *_TABLES, "bounds")
        if not isinstance(content, dict):
            raise ValueError(f"it holds {_shown(content)}; it must be an object with keys {', '.join(known)}.")
        for key in content:
            if key not in known:
                raise ValueError(
                    f"unknown key {_shown(key)}{did_you_mean(key, known)}; the keys are {', '.join(known)}."
                )
        for key in known[:3]:
            if key not in content:
                raise ValueError(f'the key "{key}" is missing; name, start and goal are required.')
        return cls(**content)

    @classmethod
    def load(cls, path: str | Path) -> World:
        """Read a world from a JSON file.

        Raises:
            UserError: the file cannot be read or is no world; names file, key and row.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except OSError as error:
            raise UserError(f"Cannot read the world {path}: {error.strerror or error}.") from error
        except UnicodeDecodeError as error:
            raise UserError(f"{path} is not a world: it is no UTF-8 text.") from error
        except json.JSONDecodeError as error:
            raise UserError(f"{path} is not JSON: {error.msg} in line {error.lineno}, column {error.colno}.") from error
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path} is not a world: {error}") from error

    @classmethod
    def from_map(
        cls,
        path: str | Path,
        *,
        voxel: float | None = None,
        start: ArrayLike | None = None,
        goal: ArrayLike | None = None,
    ) -> World:
        """Return the world of a map of points, PCD, PLY, LAS, LAZ or NPY, or of a mesh, OBJ, STL, GLB, OFF or PLY.

        Every voxel that holds a point is solid; neighbours are merged into larger boxes. The triangles of a mesh stay
        as they are. A map whose points lie beyond 10 km is moved so that its lowest corner is near the origin, `start`
        and `goal` with it.

        Args:
            path: file; its name is the world's.
            voxel: edge of a voxel [m], about the spacing of the points: smaller leaves holes, larger closes gaps; None
                is 0.2. A mesh has none.
            start: [m], shape [3], in the map's frame. None is a place 2 m over the local ground, at least 0.75 m and
                rather 1.5 m from all points, near the map's origin or, where that lies outside, its middle; 45 m from
                `goal` if that is given.
            goal: [m], shape [3], in the map's frame. None is the farthest such place within 45 m of the start that a
                drone of radius 0.5 m can reach.

        Raises:
            UserError: the file is no map that can be read, an argument is impossible, or there is no such place.
        """
        from aero_viz.scenes.maps import map_world

        return map_world(path, voxel=voxel, start=start, goal=goal)

    def to_dict(self) -> dict[str, Any]:
        """Return the form of the JSON file; "bounds" only where they differ from the derived ones."""
        content: dict[str, Any] = {"name": self.name}
        for key in ("start", "goal", *_TABLES):
            if key != "triangles" or len(self.triangles):
                content[key] = getattr(self, key).tolist()
        if not np.array_equal(self.bounds, self._derived_bounds()):
            content["bounds"] = self.bounds.tolist()
        return content

    def save(self, path: str | Path) -> None:
        """Write the world to a JSON file, one primitive per line.

        Raises:
            UserError: the file cannot be written.
        """
        lines = []
        for key, value in self.to_dict().items():
            text = json.dumps(value)
            if key in _TABLES and value:
                text = "[\n" + ",\n".join(f"    {json.dumps(row)}" for row in value) + "\n  ]"
            lines.append(f'  "{key}": {text}')
        try:
            Path(path).write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        except OSError as error:
            raise UserError(f"Cannot write the world {path}: {error.strerror or error}.") from error

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the exact distance to the nearest surface [m], shape [n], of points in the world, shape [n, 3].

        Negative inside a primitive; where primitives overlap, the depth in the one that is entered deepest. Infinite in
        an empty world. To triangles in single precision.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        nearest = np.full(len(points), np.inf)
        for key, function in _DISTANCES.items():
            table = getattr(self, key)
            if len(table) == 0:
                continue
            step = max(1, _CHUNK // len(table))
            for first in range(0, len(points), step):
                part = slice(first, first + step)
                nearest[part] = np.minimum(nearest[part], function(points[part, None, :], table).min(axis=1))
        if len(self.triangles) and len(points):
            nearest = np.minimum(nearest, self._tree.nearest(points)[0])
        return nearest

    def nearest(self, point: ArrayLike) -> tuple[float, str]:
        """Return the `distance` at `point` [m], shape [3], and what is there, such as '"spheres" row 3'."""
        place = np.asarray(point, dtype=np.float64)
        found: list[tuple[float, str]] = [(np.inf, "nothing")]
        for key, function in _DISTANCES.items():
            if len(table := getattr(self, key)):
                distances = function(place, table)
                row = int(distances.argmin())
                is_ground = key == "boxes" and self.ground[row]
                found.append((float(distances[row]), "the ground" if is_ground else f'"{key}" row {row}'))
        if len(self.triangles):
            distances, rows = self._tree.nearest(place)
            found.append((float(distances[0]), f'"triangles" row {rows[0]}'))
        return min(found)

    def to_meshes(self) -> dict[str, Mesh]:
        """Return triangles for drawing, one mesh per kind present: the names of the tables, and "ground" of boxes."""
        return to_meshes(self)

    @property
    def ground(self) -> NDArray[np.bool_]:
        """Which boxes are ground, shape [n]: they lie under both start and goal."""
        above = np.ones(len(self.boxes), dtype=bool)
        for point in (self.start, self.goal):
            local = _rotate_z(point - self.boxes[:, :3], -self.boxes[:, 6])
            half = 0.5 * self.boxes[:, 3:6]
            above &= np.all(np.abs(local[:, :2]) <= half[:, :2], axis=1) & (local[:, 2] >= half[:, 2])
        return above

    @property
    def ground_height(self) -> float | None:
        """Height of the flat ground below start and goal [m]; None where there is none."""
        boxes = self.boxes[self.ground]
        return float((boxes[:, 2] + 0.5 * boxes[:, 5]).max()) if len(boxes) else None

    @cached_property
    def _tree(self) -> TriangleTree:
        from aero_viz.scenes.triangles import TriangleTree

        return TriangleTree(self.triangles)

    def _derived_bounds(self) -> NDArray[np.float64]:
        lower, upper = primitive_bounds(self.cylinders, self.boxes, self.spheres)
        corners = self.triangles.reshape(-1, 3)
        lower = np.vstack([lower, corners, self.start, self.goal]).min(axis=0)
        upper = np.vstack([upper, corners, self.start, self.goal]).max(axis=0)
        return np.stack([lower - _BOUNDS_MARGIN, upper + _BOUNDS_MARGIN])


def primitive_bounds(
    cylinders: NDArray[np.float64], boxes: NDArray[np.float64], spheres: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and upper corners of the axis-aligned box of every primitive, each [n, 3], in this order."""
    base, axis, radius, height = np.split(cylinders, [3, 6, 7], axis=1)
    tip = base + height * axis
    rim = radius * np.sqrt(np.clip(1.0 - axis**2, 0.0, 1.0))  # half extent of a disc with normal a
    c, s = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    hx, hy, hz = 0.5 * boxes[:, 3:6].T
    half = np.stack([c * hx + s * hy, s * hx + c * hy, hz], axis=1)
    lower = [np.minimum(base, tip) - rim, boxes[:, :3] - half, spheres[:, :3] - spheres[:, 3:]]
    upper = [np.maximum(base, tip) + rim, boxes[:, :3] + half, spheres[:, :3] + spheres[:, 3:]]
    return np.vstack(lower), np.vstack(upper)


def _rotate_z(vectors: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _solid(excess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distance from the excess over each half extent, last axis: outside the norm, inside the largest."""
    outside = np.sqrt(np.sum(np.maximum(excess, 0.0) ** 2, axis=-1))
    return outside + np.minimum(excess.max(axis=-1), 0.0)


def _to_cylinders(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    relative = points - table[:, :3]
    along = np.sum(relative * table[:, 3:6], axis=-1)
    across = np.linalg.norm(relative - along[..., None] * table[:, 3:6], axis=-1)
    half = 0.5 * table[:, 7]
    return _solid(np.stack([across - table[:, 6], np.abs(along - half) - half], axis=-1))


def _to_boxes(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    return _solid(np.abs(_rotate_z(points - table[:, :3], -table[:, 6])) - 0.5 * table[:, 3:6])


def _to_spheres(points: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.sum((points - table[:, :3]) ** 2, axis=-1)) - table[:, 3]


_DISTANCES = {"cylinders": _to_cylinders, "boxes": _to_boxes, "spheres": _to_spheres}


def _store(world: World, key: str, value: NDArray[np.float64]) -> None:
    value.flags.writeable = False
    object.__setattr__(world, key, value)


def _shown(value: Any) -> str:
    """Return a value as an error shows it: a few words, whatever it is."""
    text = reprlib.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _sequence(value: Any, where: str, expected: str) -> Any:
    if isinstance(value, (list, tuple, np.ndarray)):
        return value
    raise ValueError(f"{where} is {_shown(value)}; it must be a list: {expected}.")


def _row(value: Any, count: int, where: str, columns: str) -> NDArray[np.float64]:
    value = _sequence(value, where, f"{count} numbers ({columns})")
    if len(value) != count:
        raise ValueError(f"{where} has {len(value)} values; it must have {count} numbers ({columns}).")
    for name, number in zip(columns.split(", "), value, strict=True):
        if isinstance(number, bool) or not isinstance(number, (int, float, np.number)) or not abs(number) < np.inf:
            raise ValueError(f"{where} has {name} = {_shown(number)}; it must be a finite number.")
        if abs(number) > sys.float_info.max:  # an integer can be
            raise ValueError(f"{where} has a {name} beyond 1e308; it must be a smaller number.")
    return np.array(value, dtype=np.float64)


def _table(value: Any, key: str, columns: str) -> NDArray[np.float64]:
    count = columns.count(",") + 1
    rows = _sequence(value, f'"{key}"', f"rows of {count} numbers ({columns})")
    if len(rows) == 0:
        return np.zeros((0, count))
    if isinstance(rows, np.ndarray) and rows.shape[1:] == (count,) and rows.dtype == float and np.isfinite(rows).all():
        return rows.copy()  # thousands of rows at once
    return np.stack([_row(row, count, f'"{key}" row {i}', columns) for i, row in enumerate(rows)])


def _check_ranges(table: NDArray[np.float64], where: str, columns: str) -> None:
    """Refuse what is out of reach, or no size, in rows of `columns`; `where` names a row by its number."""
    for j, name in enumerate(columns.split(", ")):
        values = table[:, j]
        if name in ("radius", "height", "sx", "sy", "sz"):
            wrong, wanted = ~((values > 0.0) & (values <= _LARGEST)), f"greater than 0 and at most {_LARGEST:g} m"
        elif name not in ("ax", "ay", "az", "yaw"):
            wrong, wanted = np.abs(values) > _REACH, f"within {_REACH:g} m of the origin"
        else:
            continue
        for i in np.flatnonzero(wrong)[:1]:
            raise ValueError(f"{where.format(i)} has {name} = {values[i]:g}; it must be {wanted}.")


def _normalise_axes(cylinders: NDArray[np.float64]) -> None:
    with np.errstate(over="ignore"):  # an absurd axis is an error all the same
        norm = np.linalg.norm(cylinders[:, 3:6], axis=1)
    for i in np.flatnonzero(np.abs(norm - 1.0) > 1e-3)[:1]:
        raise ValueError(f'"cylinders" row {i} has an axis of length {norm[i]:g}; (ax, ay, az) must be a unit vector.')
    # Axes that are unit vectors to rounding stay as they are: saving and loading changes nothing.
    cylinders[:, 3:6] /= np.where(np.abs(norm - 1.0) > 1e-12, norm, 1.0)[:, None]
