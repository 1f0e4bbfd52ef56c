"""Sentences about flights: what ended one, and what keeps one from being flown at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_viz.errors import UserError
from aero_viz.flight.rules import FlightRules
from aero_viz.scenes.world import World

__all__ = ["explain", "goal_problem", "refuse_impossible"]


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
    """Return in one sentence what ended a flight, None for an arrival.

    Args:
        reason: outcome of the flight; None when it was not over.
        world: where it was flown.
        position: last position [m], shape [3].
        time: at which it ended [s].
        clearance: least distance to a surface [m]; of a collision, the one that ended it.
        goal: that was flown to [m], shape [3].
        rules: of the flight.
    """
    place = np.asarray(position, dtype=np.float64)
    left = float(np.linalg.norm(np.asarray(goal, dtype=np.float64) - place))
    if reason == "arrived":
        return None
    if reason == "collision":
        solid = world.nearest(place)[1]
        who = "The start is" if time == 0.0 else f"After {time:.2f} s the drone was"
        if clearance < 0.0:
            return f"{who} inside an obstacle, {-clearance:.3f} m deep in {solid}, at {_point(place)}."
        return (
            f"{who} {clearance:.3f} m from {solid}, nearer than the radius of {rules.radius:g} m, at {_point(place)}."
        )
    if reason == "stall":
        return (
            f"The drone came no {rules.stall_distance:g} m nearer to the goal within {rules.stall_time:g} s and is at "
            f"{_point(place)}, {left:.1f} m before it."
        )
    if reason == "out_of_bounds":
        return f"The drone left the world's bounds, {_box(world.bounds)}, at {_point(place)}."
    if reason == "timeout":
        return f"The {rules.time_limit:g} s to reach the goal were over {left:.1f} m before it, at {_point(place)}."
    return f"It ends after {time:.2f} s, {left:.1f} m before the goal, at {_point(place)}."


def goal_problem(world: World, goal: NDArray[np.float64]) -> str | None:
    """Return why nobody can fly to a goal [m], shape [3], such as "The goal (9, 0, -2) lies 2.00 m below the ground of
    the world 'forest'"; None when nothing is in the way."""
    where = _outside(world, goal)
    if where is None:
        depth, (distance, solid) = _below_ground(world, goal), world.nearest(goal)
        if depth > 0.0:
            where = f"{depth:.2f} m below the ground of the world {world.name!r}"
        elif distance < 0.0:
            where = f"inside an obstacle of the world {world.name!r}, {-distance:.2f} m deep in {solid}"
    return where and f"The goal {_point(goal)} lies {where}"


def refuse_impossible(world: World, *, rules: FlightRules, speed_limit: float) -> None:
    """Refuse a world in which no flight can arrive, whoever flies. A start in an obstacle is not refused: it collides.

    Args:
        world: where to fly.
        rules: when the flight ends.
        speed_limit: of the planner [m/s].

    Raises:
        UserError: the goal lies in an obstacle or too far to be reached in time, or an end lies outside the bounds.
    """
    if where := _outside(world, world.start):
        raise UserError(f"The start {_point(world.start)} lies {where}; give another start.")
    if problem := goal_problem(world, world.goal):
        raise UserError(f"{problem}; give another goal.")
    way = float(np.linalg.norm(world.goal - world.start)) - rules.arrival_radius
    time_limit = max(rules.time_limit, FlightRules().time_limit)  # who sets a shorter one wants a piece of the flight
    if way > speed_limit * time_limit:
        raise UserError(
            f"The goal {_point(world.goal)} of the world {world.name!r} is {way + rules.arrival_radius:.0f} m away: "
            f"{speed_limit:g} m/s do not reach it within the flight's {time_limit:g} s; "
            "give a nearer goal, or raise the time limit or the speed."
        )


def _point(place: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{round(float(value), 2) + 0.0:g}" for value in place) + ")"


def _outside(world: World, place: NDArray[np.float64]) -> str | None:
    lower, upper = world.bounds
    inside = bool(((place >= lower) & (place <= upper)).all())
    return None if inside else f"outside the bounds of the world {world.name!r}, {_box(world.bounds)}"


def _below_ground(world: World, place: NDArray[np.float64]) -> float:
    """Return how far the top of the ground is above a place that lies over or under it [m]; negative above."""
    depth = -np.inf
    for x, y, z, length, width, height, yaw in world.boxes[world.ground]:
        c, s, along, across = np.cos(yaw), np.sin(yaw), place[0] - x, place[1] - y
        if abs(c * along + s * across) <= 0.5 * length and abs(c * across - s * along) <= 0.5 * width:
            depth = max(depth, z + 0.5 * height - place[2])
    return float(depth)


def _box(corners: NDArray[np.float64]) -> str:
    sides = zip("xyz", *corners.tolist(), strict=True)
    return ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in sides)
