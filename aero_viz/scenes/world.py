"""Worlds: cylinders, boxes, spheres and triangles with a start and a goal; exact distances; JSON files.

Cylinders may move. Unless a time is given, they are where they are at time 0; `World.at` returns another time.
"""

from __future__ import annotations

import json
import reprlib
import sys
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.missions import Mission
from aero_planner.output_files import whole_file
from aero_planner.parameters import did_you_mean
from aero_planner.user_file import parse_json, read_user_text
from aero_viz.errors import UserError
from aero_viz.input_limits import TEXT_MAX
from aero_viz.scenes.motion import check_motion, displacements
from aero_viz.scenes.primitives import DISTANCES, primitive_bounds, rotate_z

if TYPE_CHECKING:
    from aero_viz.scenes.triangles import TriangleTree

_COLUMNS = {
    "cylinders": "bx, by, bz, ax, ay, az, radius, height",
    "boxes": "cx, cy, cz, sx, sy, sz, yaw",
    "spheres": "x, y, z, radius",
    "triangles": "x1, y1, z1, x2, y2, z2, x3, y3, z3",
    "motion": "vx, vy, span",
}
_OPTIONAL = ("triangles", "motion")
"""Tables that the JSON file has only if they are not empty."""
_NAMES = {"cylinders": "cylinder", "boxes": "box", "spheres": "sphere", "triangles": "triangle"}
_BOUNDS_MARGIN = 10.0  # [m]; large, so that a drone that leaves the derived bounds has flown away, not cut a corner
_COORDINATE_MAX = 100_000.0  # [m]; farther from the origin, single precision does not resolve centimetres
_SIZE_MAX = 100_000.0  # [m]
_PAIRS_MAX = 2_000_000  # point-primitive pairs that `World.distance` computes at once


@dataclass(frozen=True, eq=False)
class World:
    """Solid primitives and triangulated surfaces with a start and a goal.

    Metres and radians, z up. Arrays are read-only float64.

    Args:
        name: shown to the user.
        start: initial position of the drone, [3].
        goal: position to fly to, [3].
        cylinders: base centre b, unit axis a, radius, height, [n, 8]; the solid spans b to b + height a.
        boxes: centre, edge lengths, yaw about z, [n, 7].
        spheres: centre, radius, [n, 4].
        bounds: lower and upper corner of the airspace, [2, 3]; None derives them from everything above plus 10 m in
            each direction.
        triangles: three corners per row, [n, 9]. Triangles form a surface without an inside; it is seen and hit from
            both sides.
        motion: horizontal velocity at time 0 [m/s] and span [m] of each cylinder, [n, 3]. A cylinder goes along its
            velocity for the span, back to where it began, and so on; one without velocity is static. Empty if all are.
        numbers: per table, numbers that identify each row even after others are removed, see `obstacles`; row numbers
            where a table has none. Not part of the JSON file.
        mission: waypoints on the way to the goal, which is the last of them; None if there are none.

    Raises:
        ValueError: a number is missing, not finite or out of range. The message names the key and the row.
    """

    name: str
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    cylinders: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 8)))
    boxes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 7)))
    spheres: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    bounds: NDArray[np.float64] = None  # type: ignore[assignment]
    triangles: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 9)))
    numbers: Any = field(default_factory=dict, repr=False)
    motion: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    mission: Mission | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise ValueError(f'"name" is {_abbreviated(self.name)}; it must be a text.')
        for key in ("start", "goal"):
            position = _row(getattr(self, key), 3, f'"{key}"', "x, y, z")
            _check_ranges(position[None], f'"{key}"', "x, y, z")
            _store(self, key, position)
        if self.mission is not None and tuple(self.goal.tolist()) != self.mission.goal:
            end = list(self.mission.goal)
            raise ValueError(f'"goal" is {self.goal.tolist()}, and the mission ends at {end}; both must be the same.')
        for key, columns in _COLUMNS.items():
            table = _table(getattr(self, key), key, columns)
            _check_ranges(table, f'"{key}" row {{}}', columns)
            if key == "cylinders":
                _normalise_axes(table)
            if key == "motion" and len(table):
                check_motion(table, len(self.cylinders))
                table = table if table[:, :2].any() else table[:0]
            _store(self, key, table)
        _store(self, "bounds", self._derived_bounds() if self.bounds is None else _corners(self.bounds))

    @classmethod
    def from_dict(cls, content: Any) -> World:
        """Return the world that `content` describes, in the form of the JSON file.

        Raises:
            ValueError: a key is missing or unknown, or a value is invalid, see the class.
        """
        known = ("name", "start", "goal", *_COLUMNS, "bounds", "mission")
        if not isinstance(content, dict):
            raise ValueError(f"it holds {_abbreviated(content)}; it must be an object with keys {', '.join(known)}.")
        for key in content:
            if key not in known:
                raise ValueError(
                    f"unknown key {_abbreviated(key)}{did_you_mean(key, known)}; the keys are {', '.join(known)}."
                )
        for key in known[:3]:
            if key not in content:
                raise ValueError(f'the key "{key}" is missing; name, start and goal are required.')
        if content.get("mission") is not None:
            try:
                content = {**content, "mission": Mission.from_dict(content["mission"])}
            except ValueError as error:
                raise ValueError(f'"mission": {error}') from error
        return cls(**content)

    @classmethod
    def load(cls, path: str | Path) -> World:
        """Read a world from a JSON file.

        Raises:
            UserError: the file cannot be read or does not describe a world. The message names file, key and row.
        """
        try:
            return cls.from_dict(parse_json(read_user_text(path, limit=TEXT_MAX), _object))
        except FileNotFoundError as error:
            raise UserError(f"There is no file {path}.") from error
        except OSError as error:
            raise UserError(f"Cannot read the world {path}: {error.strerror or error}.") from error
        except UnicodeDecodeError as error:
            raise UserError(f"{path} is not a world: it is not UTF-8 text.") from error
        except ValueError as error:
            raise UserError(f"{path} is not a world: {str(error).rstrip('.')}.") from error

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the JSON file; "bounds" only where they differ from the derived ones."""
        content: dict[str, Any] = {"name": self.name}
        for key in ("start", "goal", *_COLUMNS):
            if key not in _OPTIONAL or len(getattr(self, key)):
                content[key] = getattr(self, key).tolist()
        if not np.array_equal(self.bounds, self._derived_bounds()):
            content["bounds"] = self.bounds.tolist()
        if self.mission is not None:
            content["mission"] = self.mission.to_dict()
        return content

    def to_json(self) -> str:
        """Return the text of the JSON file, one primitive per line."""
        lines = []
        for key, value in self.to_dict().items():
            text = json.dumps(value)
            if key in _COLUMNS and value:
                text = "[\n" + ",\n".join(f"    {json.dumps(row)}" for row in value) + "\n  ]"
            lines.append(f'  "{key}": {text}')
        return "{\n" + ",\n".join(lines) + "\n}\n"

    def save(self, path: str | Path) -> None:
        """Write the world to a JSON file.

        Raises:
            UserError: the file cannot be written.
        """
        try:
            with whole_file(Path(path), alone=True) as partial:
                partial.write_text(self.to_json(), encoding="utf-8")
        except OSError as error:
            raise UserError(f"Cannot write the world {path}: {error.strerror or error}.") from error

    def distance(self, points: ArrayLike, times: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the exact distance from each point to the nearest surface [m], [n].

        The distance is negative inside a primitive; where primitives overlap, it is the largest depth. It is infinite
        in an empty world. Distances to triangles have single precision.

        Args:
            points: [m], [n, 3], world frame.
            times: when the points are there [s], [n] or one for all; they matter only if something moves.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        times = np.broadcast_to(np.asarray(times, dtype=np.float64), len(points))
        nearest = np.full(len(points), np.inf)
        for key, distance in DISTANCES.items():
            table = getattr(self, key)
            if len(table) == 0:
                continue
            step = max(1, _PAIRS_MAX // len(table))
            for first in range(0, len(points), step):
                part = slice(first, first + step)
                places = points[part, None, :]
                if key == "cylinders" and len(self.motion):  # the point moves instead, the other way
                    places = places - np.pad(displacements(self.motion, times[part]), ((0, 0), (0, 0), (0, 1)))
                nearest[part] = np.minimum(nearest[part], distance(places, table).min(axis=1))
        if len(self.triangles) and len(points):
            nearest = np.minimum(nearest, self._tree.nearest(points)[0])
        return nearest

    def nearest(self, point: ArrayLike) -> tuple[float, str]:
        """Return the `distance` of a point [m], [3], and kind and row of that obstacle, such as 'sphere 3'."""
        position = np.asarray(point, dtype=np.float64)
        candidates: list[tuple[float, str]] = [(np.inf, "nothing")]
        for key, distance in DISTANCES.items():
            if len(table := getattr(self, key)):
                distances = distance(position, table)
                row = int(distances.argmin())
                is_ground = key == "boxes" and self.ground[row]
                candidates.append((float(distances[row]), "the ground" if is_ground else f"{_NAMES[key]} {row}"))
        if len(self.triangles):
            distances, rows = self._tree.nearest(position)
            candidates.append((float(distances[0]), f"{_NAMES['triangles']} {rows[0]}"))
        return min(candidates)

    @cached_property
    def route(self) -> Mission:
        """What is flown: the mission, or the way to the goal."""
        return self.mission or Mission.to_goal(self.goal)

    def with_goal(self, goal: ArrayLike) -> World:
        """Return the world with another goal [m], [3], to which no waypoints lead."""
        return replace(self, goal=np.asarray(goal, dtype=np.float64), mission=None)

    def with_mission(self, mission: Mission) -> World:
        """Return the world with another mission, whose end is the goal."""
        return replace(self, goal=np.array(mission.goal), mission=mission)

    def inside(self, place: ArrayLike) -> NDArray[np.float64]:
        """Return the place [m], [3], or the nearest one that is a metre inside the bounds if it lies outside them."""
        place, (lower, upper) = np.asarray(place, dtype=np.float64), self.bounds
        if ((place >= lower) & (place <= upper)).all():
            return place
        margin = np.minimum(1.0, 0.5 * (upper - lower))
        return np.clip(place, lower + margin, upper - margin)

    def at(self, time: float) -> World:
        """Return the world of one moment [s], in which nothing moves; this world if nothing moves anyway."""
        if not len(self.motion):
            return self
        cylinders = self.cylinders.copy()
        cylinders[:, :2] += displacements(self.motion, time)
        return replace(self, cylinders=cylinders, motion=self.motion[:0])

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Mask of the cylinders that move, [n]."""
        moves = np.zeros(len(self.cylinders), dtype=bool)
        moves[: len(self.motion)] = np.linalg.norm(self.motion[:, :2], axis=1) > 0.0
        return moves

    def standing(self) -> World:
        """Return the world without the cylinders that move; this world if nothing moves."""
        if not len(self.motion):
            return self
        return replace(self, cylinders=self.cylinders[~self.moves], motion=self.motion[:0], numbers={})

    @property
    def ground(self) -> NDArray[np.bool_]:
        """Mask of the boxes that are ground, [n]: those that lie under both start and goal.

        If there are none, a box under the start whose top reaches over the goal is: the goal then lies below ground.
        """
        under_start, covers_goal, under_goal = np.ones((3, len(self.boxes)), dtype=bool)
        for point, covers, under in ((self.start, under_start, under_start), (self.goal, covers_goal, under_goal)):
            local = rotate_z(point - self.boxes[:, :3], -self.boxes[:, 6])
            half = 0.5 * self.boxes[:, 3:6]
            covers &= np.all(np.abs(local[:, :2]) <= half[:, :2], axis=1)
            under &= local[:, 2] >= half[:, 2]
        ground = under_start & covers_goal & under_goal
        return ground if ground.any() else under_start & covers_goal

    @property
    def ground_height(self) -> float | None:
        """Height of the flat ground under start and goal [m], see `ground`; None in a world without ground."""
        boxes = self.boxes[self.ground]
        return float((boxes[:, 2] + 0.5 * boxes[:, 5]).max()) if len(boxes) else None

    @cached_property
    def _tree(self) -> TriangleTree:
        from aero_viz.scenes.triangles import TriangleTree

        return TriangleTree(self.triangles)

    def _derived_bounds(self) -> NDArray[np.float64]:
        cylinders = self.cylinders
        if len(self.motion):
            turned = cylinders.copy()
            speed = np.linalg.norm(self.motion[:, :2], axis=1, keepdims=True)
            turned[:, :2] += self.motion[:, :2] / np.where(speed > 0.0, speed, 1.0) * self.motion[:, 2:]
            cylinders = np.vstack([cylinders, turned])
        lower, upper = primitive_bounds(cylinders, self.boxes, self.spheres)
        corners = self.triangles.reshape(-1, 3)
        places = [self.goal] if self.mission is None else self.mission.places(self.start)
        lower = np.vstack([lower, corners, self.start, *places]).min(axis=0)
        upper = np.vstack([upper, corners, self.start, *places]).max(axis=0)
        return np.stack([lower - _BOUNDS_MARGIN, upper + _BOUNDS_MARGIN])


def _store(world: World, key: str, value: NDArray[np.float64]) -> None:
    value.flags.writeable = False
    object.__setattr__(world, key, value)


def _abbreviated(value: Any) -> str:
    """Return the representation of any value, shortened to fit an error message."""
    text = reprlib.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _sequence(value: Any, where: str, expected: str) -> Any:
    if isinstance(value, (list, tuple, np.ndarray)):
        return value
    raise ValueError(f"{where} is {_abbreviated(value)}; it must be a list: {expected}.")


def _row(value: Any, count: int, where: str, columns: str) -> NDArray[np.float64]:
    value = _sequence(value, where, f"{count} numbers ({columns})")
    if len(value) != count:
        raise ValueError(f"{where} has {len(value)} values; it must have {count} numbers ({columns}).")
    for name, number in zip(columns.split(", "), value, strict=True):
        if isinstance(number, bool) or not isinstance(number, (int, float, np.number)) or not abs(number) < np.inf:
            raise ValueError(f"{where} has {name} = {_abbreviated(number)}; it must be a finite number.")
        if abs(number) > sys.float_info.max:  # possible for an integer
            raise ValueError(f"{where} has a {name} beyond 1e308; it must be a smaller number.")
    return np.array(value, dtype=np.float64)


def _table(value: Any, key: str, columns: str) -> NDArray[np.float64]:
    count = columns.count(",") + 1
    rows = _sequence(value, f'"{key}"', f"rows of {count} numbers ({columns})")
    if len(rows) == 0:
        return np.zeros((0, count))
    if isinstance(rows, np.ndarray) and rows.shape[1:] == (count,) and rows.dtype == float and np.isfinite(rows).all():
        return rows.copy()  # avoids checking thousands of rows one by one
    return np.stack([_row(row, count, f'"{key}" row {i}', columns) for i, row in enumerate(rows)])


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; ValueError if it has a key twice, of which JSON would keep the last."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"the key {_abbreviated(key)} is given twice; keep one.")
        content[key] = value
    return content


def _corners(bounds: Any) -> NDArray[np.float64]:
    rows = _sequence(bounds, '"bounds"', "two corners")
    if len(rows) != 2:
        raise ValueError(f'"bounds" has {len(rows)} rows; it must be two corners, the lower and the upper.')
    corners = np.stack([_row(row, 3, f'"bounds" row {i}', "x, y, z") for i, row in enumerate(rows)])
    if not np.all(corners[0] < corners[1]):
        raise ValueError('"bounds" row 0 must be less than row 1 in x, y and z.')
    return corners


def _check_ranges(table: NDArray[np.float64], where: str, columns: str) -> None:
    """Refuse coordinates and sizes that are out of range; `where` is a format string that takes the row number."""
    for j, name in enumerate(columns.split(", ")):
        values = table[:, j]
        if name in ("radius", "height", "sx", "sy", "sz"):
            wrong, expected = ~((values > 0.0) & (values <= _SIZE_MAX)), f"greater than 0 and at most {_SIZE_MAX:g} m"
        elif name == "yaw":
            wrong, expected = np.abs(values) > 2.0 * np.pi, "an angle [rad] within 2 pi of 0; 90 deg are 1.5708"
        elif name not in ("ax", "ay", "az"):
            wrong, expected = np.abs(values) > _COORDINATE_MAX, f"within {_COORDINATE_MAX:g} m of the origin"
        else:
            continue
        for i in np.flatnonzero(wrong)[:1]:
            raise ValueError(f"{where.format(i)} has {name} = {values[i]:g}; it must be {expected}.")


def _normalise_axes(cylinders: NDArray[np.float64]) -> None:
    with np.errstate(over="ignore"):  # an overflow gives inf, which is refused below
        norm = np.linalg.norm(cylinders[:, 3:6], axis=1)
    for i in np.flatnonzero(np.abs(norm - 1.0) > 1e-3)[:1]:
        raise ValueError(f'"cylinders" row {i} has an axis of length {norm[i]:g}; (ax, ay, az) must be a unit vector.')
    # Axes that are unit vectors to rounding stay unchanged, so that saving and loading changes nothing.
    cylinders[:, 3:6] /= np.where(np.abs(norm - 1.0) > 1e-12, norm, 1.0)[:, None]
