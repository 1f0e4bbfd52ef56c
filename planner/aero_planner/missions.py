"""Missions: waypoints that are flown one after another. A single goal is a mission of one waypoint."""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from aero_planner.parameters import did_you_mean

Position = tuple[float, float, float]
"""x, y, z [m], world frame."""

RADIUS = 1.0
"""Default of the radius of a waypoint [m]."""
TIMEOUT = 10.0
"""Default of the time without coming nearer after which a waypoint is given up [s]."""
WAYPOINT_FORM = "X,Y,Z[,radius=R][,stop][,hold=T][,speed=V][,timeout=T]"
"""Form of a waypoint as text, see `Waypoint.parse`."""
_COORDINATE_MAX = 1e8
"""Maps may have the coordinates of a whole country [m]."""
_RADIUS_MAX = 100.0
_TIMEOUT_MAX = _HOLD_MAX = 600.0
_ROWS_MAX = 100_000


@dataclass(frozen=True)
class Waypoint:
    """A place to pass or to stop at, or a recorded path to follow.

    Args:
        position: [m], world frame; with a path, its end.
        radius: how near the drone must come [m].
        stop: True if the drone must stop there, False if it flies on.
        speed: speed limit of the leg that leads there [m/s]; None is that of the configuration.
        timeout: time without coming nearer after which the drone flies on to the next waypoint [s]. It is not the time
            of the whole leg, so that one value fits legs of any length, and a detour that makes progress has no limit.
        hold: time for which the drone stays at the stop [s].
        path: rows of time [s] and x, y, z [m]: the goal moves along them from the beginning of the leg on, and the leg
            ends when its end is reached; empty for a goal that stands.

    Raises:
        ValueError: a value is out of range; the text says which, and what is possible.
    """

    position: Position
    radius: float = RADIUS
    stop: bool = False
    speed: float | None = None
    timeout: float = TIMEOUT
    hold: float = 0.0
    path: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        rows = [_numbers(row, 4, f"row {i + 1} of the path", "t, x, y, z") for i, row in enumerate(self.path)]
        if len(rows) > _ROWS_MAX:
            raise ValueError(f"the path has {len(rows)} rows; give at most {_ROWS_MAX}.")
        for i, (before, after) in enumerate(pairwise(rows)):
            if not before[0] < after[0]:
                raise ValueError(f"the time of row {i + 2} of the path is {after[0]:g}; times must increase.")
        object.__setattr__(self, "path", tuple(rows))
        object.__setattr__(self, "position", _numbers(self.position, 3, "the position", "x, y, z"))
        if rows and rows[-1][1:] != self.position:
            raise ValueError(f"the position is {point(self.position)}; with a path it must be its end, or absent.")
        for name, most, unit in (("radius", _RADIUS_MAX, "m"), ("timeout", _TIMEOUT_MAX, "s")):
            value = _number(getattr(self, name), f"{name}")
            if not 0.0 < value <= most:
                raise ValueError(f"{name} is {value:g}; it must be greater than 0 and at most {most:g} {unit}.")
            object.__setattr__(self, name, value)
        if not isinstance(self.stop, bool):
            raise ValueError(f"stop is {_short(self.stop)}; it must be true or false.")
        object.__setattr__(self, "hold", _number(self.hold, "hold"))
        if not 0.0 <= self.hold <= (_HOLD_MAX if self.stop else 0.0):
            raise ValueError(f"hold is {self.hold:g}; it must be 0 to {_HOLD_MAX:g} s, and 0 without a stop.")
        if self.speed is not None:
            from aero_planner.config import PlannerConfig  # not before a script has added its own stages and terms

            speed = PlannerConfig.find("vehicle.speed_limit").check(_number(self.speed, "speed"))
            object.__setattr__(self, "speed", float(speed))

    @classmethod
    def from_dict(cls, content: Any) -> Waypoint:
        """Return the waypoint of a mapping with the arguments of the class; raises ValueError as the class does."""
        known = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(content, Mapping):
            raise ValueError(f"it is {_short(content)}; write the keys {', '.join(known)}.")
        values = dict(content)
        for key in values:
            if key not in known:
                raise ValueError(f"unknown key {_short(key)}{did_you_mean(str(key), known)}; give {', '.join(known)}.")
        if "path" in values:
            rows = values["path"]
            if not isinstance(rows, Sequence) or isinstance(rows, str) or not rows:
                raise ValueError(f"the path is {_short(rows)}; it must be rows of t, x, y, z.")
            values["path"] = tuple(
                _numbers(row, 4, f"row {i + 1} of the path", "t, x, y, z") for i, row in enumerate(rows)
            )
            values.setdefault("position", values["path"][-1][1:])
        if "position" not in values:
            raise ValueError("the position is missing; give x, y, z [m].")
        return cls(**values)

    @classmethod
    def parse(cls, text: str) -> Waypoint:
        """Return the waypoint of a text such as "10,0,2", "10,0,2,stop,hold=5" or "10,0,2,radius=0.5,speed=3".

        Raises:
            ValueError: the text is malformed, or a value is out of range.
        """
        named = ("radius", "hold", "speed", "timeout")
        words = [word.strip() for word in text.split(",")]
        values: dict[str, Any] = {}
        try:
            if len(words) < 3:
                raise ValueError("it has no three coordinates.")
            values["position"] = tuple(_parsed(word, "a coordinate") for word in words[:3])
            for word in words[3:]:
                name, _, value = word.partition("=")
                if name not in named and word != "stop":
                    raise ValueError(f"{word!r} is unknown{did_you_mean(name, [*named, 'stop'])}.")
                if name in values:
                    raise ValueError(f"{name} is given twice.")
                values[name] = True if word == "stop" else _parsed(value, name)
            return cls(**values)
        except ValueError as error:
            raise ValueError(f"the waypoint {text!r} is not of the form {WAYPOINT_FORM}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return the values that differ from the defaults, in the form of `from_dict`."""
        values: dict[str, Any] = {"path": [list(row) for row in self.path]} if self.path else {}
        if not self.path:
            values["position"] = list(self.position)
        for field in dataclasses.fields(self):
            if field.name not in ("position", "path") and getattr(self, field.name) != field.default:
                values[field.name] = getattr(self, field.name)
        return values

    @property
    def duration(self) -> float:
        """Time for which the goal moves [s]; 0 for one that stands."""
        return self.path[-1][0] - self.path[0][0] if self.path else 0.0

    def at(self, elapsed: float) -> Position:
        """Return where the goal is a time [s] after the beginning of the leg, linear between the rows of the path."""
        if not self.path or elapsed >= self.duration:
            return self.position
        time = self.path[0][0] + max(elapsed, 0.0)
        row = bisect.bisect_right(self.path, time, key=lambda entry: entry[0])
        before, after = self.path[row - 1], self.path[row]
        return between(before[1:], after[1:], (time - before[0]) / (after[0] - before[0]))


@dataclass(frozen=True)
class Mission:
    """Waypoints in the order in which they are flown; the last one is the goal of the flight.

    Raises:
        ValueError: there is none.
    """

    waypoints: tuple[Waypoint, ...]

    def __post_init__(self) -> None:
        if not self.waypoints:
            raise ValueError("the mission has no waypoints; give at least one.")

    @classmethod
    def to_goal(cls, position: ArrayLike) -> Mission:
        """Return the mission that ends with a stop at one goal [m]."""
        return cls((Waypoint(as_position(position), stop=True),))

    @classmethod
    def from_dict(cls, content: Any) -> Mission:
        """Return the mission of {"waypoints": [{"position": [x, y, z], ..}, ..]}, see `Waypoint`.

        Raises:
            ValueError: a key is missing or unknown, or a value is out of range; the text names the waypoint.
        """
        if not isinstance(content, Mapping) or set(content) != {"waypoints"}:
            found = f"the keys {', '.join(map(str, content))}" if isinstance(content, Mapping) else _short(content)
            raise ValueError(f"the mission has {found}; it must have the key waypoints and no other.")
        rows = content["waypoints"]
        if not isinstance(rows, Sequence) or isinstance(rows, str):
            raise ValueError(f"waypoints is {_short(rows)}; it must be a list, each with a position or a path.")
        waypoints = []
        for i, row in enumerate(rows):
            try:
                waypoints.append(Waypoint.from_dict(row))
            except ValueError as error:
                raise ValueError(f"waypoint {i + 1}: {error}") from None
        return cls(tuple(waypoints))

    def to_dict(self) -> dict[str, Any]:
        """Return the mission in the form of `from_dict`, of values that YAML and JSON can hold."""
        return {"waypoints": [waypoint.to_dict() for waypoint in self.waypoints]}

    def __len__(self) -> int:
        return len(self.waypoints)

    @property
    def is_single(self) -> bool:
        """True if there is one waypoint, which does not move."""
        return len(self) == 1 and not self.waypoints[0].path

    @property
    def goal(self) -> Position:
        """Position of the last waypoint [m]."""
        return self.waypoints[-1].position

    def moved(self, offset: ArrayLike) -> Mission:
        """Return the mission at another place: all positions and paths plus an offset [m]."""
        x, y, z = as_position(offset)
        if not any((x, y, z)):
            return self
        waypoints = []
        for waypoint in self.waypoints:
            path = tuple((t, a + x, b + y, c + z) for t, a, b, c in waypoint.path)
            a, b, c = waypoint.position
            waypoints.append(dataclasses.replace(waypoint, position=(a + x, b + y, c + z), path=path))
        return Mission(tuple(waypoints))

    def places(self, start: ArrayLike) -> list[Position]:
        """Return the corners of the path from a start [m] along all waypoints, those of recorded paths included."""
        places = [as_position(start)]
        for waypoint in self.waypoints:
            places += [row[1:] for row in waypoint.path] or [waypoint.position]
        return places

    def length(self, start: ArrayLike) -> float:
        """Return the length of the straight legs from a start [m] along all waypoints [m]."""
        places = self.places(start)
        return sum(math.dist(a, b) for a, b in pairwise(places))

    def duration(self, start: ArrayLike, speed_limit: float) -> float:
        """Return the time that the legs take at their speed limits, or at `speed_limit` [m/s] where they have none [s].

        A drone takes longer: it accelerates, brakes and flies around obstacles.
        """
        place, total = as_position(start), 0.0
        for waypoint in self.waypoints:
            begin = waypoint.at(0.0)
            total += math.dist(place, begin) / (waypoint.speed or speed_limit)
            total += waypoint.duration
            place = waypoint.position
        return total


def as_position(position: ArrayLike) -> Position:
    """Return a position [m], [3], as a tuple."""
    x, y, z = np.asarray(position, dtype=np.float64).tolist()
    return x, y, z


def between(a: Position, b: Position, share: float) -> Position:
    """Return the place at a share of the way from a to b."""
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2])


def point(place: ArrayLike) -> str:
    """Return a place as text, such as "(10, 0, 2)"."""
    return "(" + ", ".join(f"{round(value, 2) + 0.0:g}" for value in as_position(place)) + ")"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
        raise ValueError(f"{name} is {_short(value)}; it must be a finite number.")
    return float(value)


def _parsed(word: str, name: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"{name} is {word!r}; it must be a number.") from None


def _numbers(row: Any, count: int, where: str, columns: str) -> Any:
    """Return a row of finite numbers as a tuple; ValueError if it is not one."""
    try:
        values = tuple(float(value) if hasattr(value, "dtype") else value for value in row)
    except TypeError:
        values = ()
    if len(values) != count or isinstance(row, (str, Mapping)):
        raise ValueError(f"{where} is {_short(row)}; it must be the {count} numbers {columns}.")
    for name, value in zip(columns.split(", "), values, strict=True):
        if abs(_number(value, f"{name} of {where}")) > _COORDINATE_MAX and name != "t":
            raise ValueError(f"{name} of {where} is {value:g}; it must be within {_COORDINATE_MAX:g} m of the origin.")
    return tuple(float(value) for value in values)
