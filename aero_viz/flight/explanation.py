"""Sentences on how flights ended, and checks that refuse flights that cannot arrive."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.missions import Mission, as_position, point
from aero_viz.errors import UserError
from aero_viz.flight.rules import FlightRules
from aero_viz.scenes.primitives import rotate_z
from aero_viz.scenes.world import World

_STEP = 0.1
"""Distance between two places at which the way to a waypoint is examined [m]."""


def explain(
    reason: str | None,
    world: World,
    position: ArrayLike,
    *,
    time: float,
    clearance: float,
    goal: ArrayLike,
    rules: FlightRules,
) -> str | None:
    """Return one sentence on how a flight ended, None for an arrival.

    Args:
        reason: outcome of the flight; None if it was not over.
        world: where it was flown.
        position: last position [m], [3].
        time: flight time [s].
        clearance: smallest distance to a surface [m]; for a collision, the one that ended the flight.
        goal: goal at the end [m], [3].
        rules: rules of the flight.
    """
    place, end = np.asarray(position, dtype=np.float64), np.asarray(goal, dtype=np.float64)
    remaining = float(np.linalg.norm(end - place))
    where = f"at {point(place)}"
    cause = goal_notice(world, end) if reason in ("stall", "timeout", None) else None
    if cause is not None:
        return f"{cause} {_ending(reason, time, rules)} {where}, {remaining:.1f} m from the goal."
    if reason == "arrived":
        return None
    if reason == "collision":
        solid = world.nearest(place)[1]
        subject = "The start is" if time == 0.0 else f"After {time:.2f} s the drone was"
        if clearance < 0.0:
            return f"{subject} inside an obstacle, {-clearance:.3f} m deep in {solid}, {where}."
        return f"{subject} {clearance:.3f} m from {solid}, closer than the radius of {rules.radius:g} m, {where}."
    if reason == "out_of_bounds":
        return f"The drone left the world's bounds, {_box(world.bounds)}, {where}."
    return f"{_ending(reason, time, rules)} {where}, {remaining:.1f} m from the goal."


def _ending(reason: str | None, time: float, rules: FlightRules) -> str:
    """Return how a flight that did not reach its goal ended."""
    if reason == "stall":
        return f"The drone moved by less than {rules.stall_distance:g} m within {rules.stall_time:g} s; it stalled"
    if reason == "timeout":
        return f"The time limit of {rules.time_limit:g} s expired"
    return f"The flight was not over after {time:.2f} s,"


def goal_notice(world: World, goal: NDArray[np.float64]) -> str | None:
    """Return one sentence on a goal [m], [3], that no drone can reach; None if nothing is known to prevent it."""
    problem = goal_problem(world, goal)
    return problem and f"{problem}, so the drone flies as near to it as is safe."


def goal_problem(world: World, goal: NDArray[np.float64]) -> str | None:
    """Return why no drone can reach a goal [m], [3]; None if nothing prevents it.

    An example is "The goal (9, 0, -2) lies 2.00 m below the ground of the world 'forest'".
    """
    where = _outside(world, goal)
    if where is None:
        depth, (distance, solid) = _depth_below_ground(world, goal), world.nearest(goal)
        if depth > 0.0:
            where = f"{depth:.2f} m below the ground of the world {world.name!r}"
        elif distance < 0.0:
            where = f"inside an obstacle of the world {world.name!r}, {-distance:.2f} m deep in {solid}"
    return where and f"The goal {point(goal)} lies {where}"


def waypoint_problem(world: World, mission: Mission) -> str | None:
    """Return which waypoint before the last one lies outside the world's bounds; None if none does.

    A waypoint may lie in an obstacle: it is flown around or given up.
    """
    for i, waypoint in enumerate(mission.waypoints[:-1], 1):
        for place in [row[1:] for row in waypoint.path] or [waypoint.position]:
            if where := _outside(world, np.array(place)):
                return f"Waypoint {i} of {len(mission)}, {point(place)}, lies {where}"
    return None


def obstruction(world: World, place: ArrayLike, waypoint: ArrayLike, *, radius: float) -> str | None:
    """Return what is in the way of a drone to a waypoint, such as "box 3 stands in between"; None if nothing is.

    Args:
        world: the world.
        place: position of the drone [m], [3].
        waypoint: [m], [3].
        radius: of the drone [m].
    """
    a, b = np.asarray(place, dtype=np.float64), np.asarray(waypoint, dtype=np.float64)
    distance, solid = world.nearest(b)
    if distance < radius:
        return f"it lies inside {solid}" if distance < 0.0 else f"it lies only {distance:.2f} m from {solid}"
    shares = np.linspace(0.0, 1.0, max(2, int(np.linalg.norm(b - a) / _STEP)))
    path = a + shares[:, None] * (b - a)
    near = np.flatnonzero(world.distance(path) < radius)
    return f"{world.nearest(path[near[0]])[1]} stands in between" if len(near) else None


def world_problem(world: World, *, must_arrive: bool = True) -> str | None:
    """Return why no flight from the start to the goal of a world can arrive; None if nothing is known that prevents it.

    A start inside an obstacle is no problem: that flight collides. Without `must_arrive`, neither is a goal that is
    flown to as near as is safe.
    """
    if where := _outside(world, world.start):
        return f"The start {point(world.start)} lies {where}; give another start."
    if problem := waypoint_problem(world, world.route):
        return f"{problem}; give another waypoint."
    problem = goal_problem(world.standing(), np.array(world.route.goal)) if must_arrive else None
    return problem and f"{problem}; give another goal."


def refuse_impossible(world: World, *, rules: FlightRules, speed_limit: float, must_arrive: bool = True) -> None:
    """Refuse a world in which no planner can arrive, see `world_problem`.

    Args:
        world: where to fly.
        rules: when the flight ends.
        speed_limit: speed limit of the planner [m/s].
        must_arrive: False if it is enough to fly as near to the goal as is safe.

    Raises:
        UserError: the goal is too far away for the time limit, the start lies outside the bounds, or, with
            `must_arrive`, the goal cannot be reached.
    """
    if problem := world_problem(world, must_arrive=must_arrive):
        raise UserError(problem)
    time_limit = max(rules.time_limit, FlightRules().time_limit)  # a shorter limit asks for a part of the flight
    place, mission = as_position(world.start), world.route
    for i, waypoint in enumerate(mission.waypoints, 1):
        begin, place = place, waypoint.position
        distance, speed = math.dist(begin, waypoint.at(0.0)), waypoint.speed or speed_limit
        if distance - rules.arrival_radius > speed * time_limit:
            name = "goal" if i == len(mission) else "waypoint"
            raise UserError(
                f"The {name} {point(place)} of the world {world.name!r} is {distance:.0f} m away and cannot be reached "
                f"at {speed:g} m/s within the time limit of {time_limit:g} s; "
                f"give a nearer {name}, or raise the time limit or the speed."
            )


def _outside(world: World, place: NDArray[np.float64]) -> str | None:
    lower, upper = world.bounds
    is_inside = bool(((place >= lower) & (place <= upper)).all())
    return None if is_inside else f"outside the bounds of the world {world.name!r}, {_box(world.bounds)}"


def _depth_below_ground(world: World, place: NDArray[np.float64]) -> float:
    """Return how far a place lies below the top of the ground [m]; negative above it, -inf outside its bounds."""
    boxes = world.boxes[world.ground]
    half, local = 0.5 * boxes[:, 3:6], rotate_z(place - boxes[:, :3], -boxes[:, 6])
    is_within = np.all(np.abs(local[:, :2]) <= half[:, :2], axis=1)
    return float((half[:, 2] - local[:, 2]).max(initial=-np.inf, where=is_within))


def _box(corners: NDArray[np.float64]) -> str:
    sides = zip("xyz", *corners.tolist(), strict=True)
    return ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in sides)
