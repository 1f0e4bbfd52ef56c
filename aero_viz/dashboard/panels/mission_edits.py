"""Changes of the waypoints ahead of a drone. Each raises UserError, and says why, if it is impossible."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from aero_planner.missions import Mission, Position, Waypoint, as_position
from aero_viz.errors import UserError
from aero_viz.planners.observation import Observation

Edit = Callable[[list[Waypoint], int], int]
"""Changes waypoints in place, given the index of the present one, and returns the index of the one to select."""


def above_ground(observation: Observation, origin: Position, direction: Position) -> Position:
    """Return the place [m] at the height of the goal above the point where a ray meets the ground, or that height.

    Args:
        observation: has a mission.
        origin, direction: of the ray [m], world frame.
    """
    assert observation.mission is not None
    height, ground = observation.mission.mission.goal[2], observation.ground_height
    fall = (height if ground is None else ground) - origin[2]
    if fall * direction[2] <= 0.0:
        raise UserError("This click does not meet the ground; click below the horizon.")
    x, y, _ = as_position(np.add(origin, fall / direction[2] * np.array(direction)))
    return x, y, height


def added(position: Position) -> Edit:
    """Return the change that adds a waypoint [m] before the goal, or after it once it is reached."""

    def edit(waypoints: list[Waypoint], index: int) -> int:
        place = max(index, len(waypoints) - 1)
        waypoints.insert(place, Waypoint(position))
        return place

    return edit


def replaced(number: int, change: Callable[[Waypoint], Waypoint]) -> Edit:
    """Return the change of one waypoint, by its index."""

    def edit(waypoints: list[Waypoint], index: int) -> int:
        _check_ahead(number, waypoints, index)
        waypoints[number] = change(waypoints[number])
        return number

    return edit


def moved(number: int, position: Position) -> Edit:
    """Return the change that puts a waypoint somewhere else [m], with its path."""
    return replaced(number, lambda old: Mission((old,)).moved(np.subtract(position, old.position)).waypoints[0])


def swapped(number: int, other: int) -> Edit:
    """Return the change that exchanges a waypoint with the one before or behind it."""

    def edit(waypoints: list[Waypoint], index: int) -> int:
        _check_ahead(number, waypoints, index)
        if not index <= other < len(waypoints):
            raise UserError(f"Waypoint {number + 1} is already the {'next' if other < number else 'last'} one.")
        waypoints[number], waypoints[other] = waypoints[other], waypoints[number]
        return other

    return edit


def removed(number: int) -> Edit:
    """Return the change that leaves a waypoint out; one must remain ahead."""

    def edit(waypoints: list[Waypoint], index: int) -> int:
        _check_ahead(number, waypoints, index)
        if index == len(waypoints) - 1:
            raise UserError("No other waypoint is ahead of the drone; add one before you remove this one.")
        del waypoints[number]
        return min(number, len(waypoints) - 1)

    return edit


def _check_ahead(number: int, waypoints: list[Waypoint], index: int) -> None:
    if not index <= number < len(waypoints):
        raise UserError(f"Waypoint {number + 1} is not ahead of the drone; choose one that is.")
