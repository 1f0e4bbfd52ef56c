"""The place around the drone from which a camera sees it, without a trunk or a wall between them."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from aero_viz.scenes import SightLines, World
from aero_viz.scenes.primitives import DISTANCES
from aero_viz.session.frame import Frame

Point = NDArray[np.float64]
Turn = tuple[float, float, float]
"""Azimuth and elevation to add to those of a camera [rad], and the factor on its distance."""

_TURNS = [
    (np.radians(sign * azimuth), np.radians(elevation), reach)
    for azimuth, elevation, reach in itertools.product((0.0, 25.0, 50.0, 80.0), (0.0, 20.0, 42.0), (1.0, 0.6))
    for sign in ((1.0, -1.0) if azimuth else (1.0,))
]
"""Places to try; the first one is the wanted place."""
_MARGIN = 0.25
"""Distance of obstacles from the line of sight [m]."""
_AHEAD = (0.0, 0.25, 0.5)
"""Times from now at which a view must be free, at the present velocity, so that it is left before it is blocked [s]."""
_PERIOD, _PAUSE = 0.06, 0.5
"""Times between two looks for obstacles, and after a search that has found no free view, which takes longest [s]."""
_PATIENCE, _RETURN = 0.1, 1.5
"""Times for which a view must be blocked before it is left, and the wanted one free before it is taken again [s]."""
_SMOOTHING = 0.3
"""Time constant of a turn [s]."""
_RATE = np.radians(120.0)
"""Largest speed of a turn [rad/s]."""
_SHORTEST, _STEEPEST = 1.2, np.radians(85.0)


class Sight:
    """Finds what blocks the view of the drone in the world of a frame."""

    def __init__(self) -> None:
        self._world: World | None = None
        self._lines: SightLines | None = None

    def found(self, frame: Frame, eye: Point, drone: Point) -> dict[str, NDArray[np.int64]]:
        """Return the rows of the obstacles between an eye and a place of the drone [m], by kind; empty without a world.

        Args:
            frame: the frame, whose world counts.
            eye: position of the eye [m], shape [3].
            drone: place of the drone [m], shape [3].
        """
        if frame.world is None:
            return {}
        if self._lines is None or frame.world is not self._world:
            self._world, self._lines = frame.world, SightLines(frame.world)
        return self._lines.blocked_by(eye, drone[None], np.array([_MARGIN]))

    def blocking(self, frame: Frame, eye: Point, drone: Point) -> int:
        """Return how many obstacles there are between an eye and a place of the drone."""
        return sum(len(rows) for rows in self.found(frame, eye, drone).values())

    def blocking_soon(self, frame: Frame, offset: Point) -> int:
        """Return how many obstacles hide the drone from an offset to it [m] in the next half second."""
        drone, velocity = frame.drone_position, np.asarray(frame.observation.actual_state.velocity, dtype=np.float64)
        places = [drone + time * velocity for time in _AHEAD]
        return sum(self.blocking(frame, place + offset, place) for place in places)

    def first_free(self, frame: Frame, wanted: Point, azimuth: float = 0.0) -> Turn:
        """Return the least turn of an offset from the drone [m] with a free view, at best near a present azimuth [rad].

        If there is none, return the turn with the fewest obstacles in the way.
        """
        least, best = np.inf, _TURNS[0]
        for turn in sorted(_TURNS, key=lambda turn: _cost(turn) + 0.5 * abs(turn[0] - azimuth)):
            count = self.blocking_soon(frame, turned(wanted, turn))
            if count < least:
                least, best = count, turn
            if count == 0:
                break
        return best


class Outlook:
    """Turns a camera that follows the drone to where it sees it, and lets it stay there as long as it can.

    A view is left only when it has been blocked for a while, and the wanted one is taken again only when it has been
    free for longer, so that the camera does not swing from trunk to trunk.
    """

    def __init__(self, sight: Sight) -> None:
        self._sight = sight
        self.reset()

    def reset(self) -> None:
        """Take the wanted view."""
        self._turn = self._shown = np.array(_TURNS[0])
        self._time: float | None = None
        self._blocked_since = self._free_since = self._due = 0.0

    def take(self, frame: Frame) -> None:
        """Take the wanted view at this tick, blocked or not: somebody has just chosen it."""
        self.reset()
        self._time = self._blocked_since = self._free_since = self._due = frame.time

    def __call__(self, frame: Frame, wanted: Point) -> Point:
        """Return the offset of the camera from the drone [m] for the wanted one, each of shape [3]."""
        now, drone = frame.time, frame.drone_position
        if self._time is None:  # a cut: no time to wait, and nothing to turn from
            self._turn = self._shown = np.array(self._sight.first_free(frame, wanted))
        step = 0.0 if self._time is None else now - self._time
        if self._time is None or step < 0.0:
            self._blocked_since = self._free_since = now
            self._due, step = now + _PERIOD, 0.0
        self._time = now
        if now >= self._due:
            self._due = now + _PERIOD
            self._choose(frame, drone, wanted, now)
        change = (1.0 - np.exp(-step / _SMOOTHING)) * (self._turn - self._shown)
        self._shown = self._shown + np.clip(change, -_RATE * step, _RATE * step)
        return turned(wanted, self._shown)

    def _choose(self, frame: Frame, drone: Point, wanted: Point, now: float) -> None:
        if not self._sight.blocking_soon(frame, turned(wanted, self._turn)):
            self._blocked_since = now
        elif now - self._blocked_since >= _PATIENCE:
            self._turn = np.array(self._sight.first_free(frame, wanted, self._turn[0]))
            self._blocked_since = now
            if self._sight.blocking_soon(frame, turned(wanted, self._turn)):
                self._due = now + _PAUSE
        if not self._turn.any() or self._sight.blocking(frame, drone + wanted, drone):
            self._free_since = now
        elif now - self._free_since >= _RETURN:
            self._turn = np.array(_TURNS[0])


def turned(offset: Point, turn: NDArray[np.float64] | Turn) -> Point:
    """Return an offset from the drone [m], shape [3], with another azimuth and elevation, and at another distance."""
    azimuth, elevation, reach = turn
    distance = float(np.linalg.norm(offset))
    steep = float(np.arctan2(offset[2], np.hypot(*offset[:2])))
    steep = min(max(steep + elevation, -_STEEPEST), max(_STEEPEST, steep))
    heading = np.arctan2(offset[1], offset[0]) + azimuth
    direction = np.array([np.cos(steep) * np.cos(heading), np.cos(steep) * np.sin(heading), np.sin(steep)])
    return max(reach * distance, min(distance, _SHORTEST)) * direction


def _cost(turn: Turn) -> float:
    azimuth, elevation, reach = turn
    return abs(azimuth) + 1.2 * elevation + 2.0 * (1.0 - reach)


def has_hit_ground(frame: Frame) -> bool:
    """Return True if the flight has ended on the ground, which is best seen from the side."""
    world = frame.world
    if frame.outcome != "collision" or world is None or not world.ground.any():
        return False
    drone = frame.drone_position
    below = float(DISTANCES["boxes"](drone[None, None], world.boxes[world.ground]).min())
    return below <= float(world.distance(drone[None])[0]) + 1e-6
