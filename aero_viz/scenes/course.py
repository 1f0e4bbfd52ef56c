"""A seeded course of gates through a forest: frames to fly through in order."""

from __future__ import annotations

from functools import partial

import numpy as np

from aero_planner.missions import Mission, Waypoint, as_position
from aero_viz.scenes.field import START, Obstacle, Rows, field_world
from aero_viz.scenes.obstacle_fields import tree
from aero_viz.scenes.primitives import DISTANCES
from aero_viz.scenes.world import World

GATES = 12
"""Number of gates of a course."""
OPENING = 2.4
"""Width and height of a gate's opening [m]."""
_FRAME = 0.2  # [m], breadth and depth of the frame's bars
_SPACING = (9.0, 12.0)  # [m], between two gates along the course
_TURN = 35.0  # [deg], largest angle between a leg and the course's direction
_BESIDE = 10.0  # [m], from the middle of the field, beyond which the course turns back to it
_HEIGHTS = (1.8, 3.0)  # [m], of the gates' centres
_RUN = 4.0  # [m] before and behind a gate that are free of trees, as wide as its opening
_LANE = 20.0  # [m], of forest on both sides of the course
_TREES_PER_AREA = 100.0 / 1600.0  # [1/m^2], as in the forest


def course(*, seed: int, gates: int = GATES, ground: bool = True) -> World:
    """Return a forest with a winding course of gates, square frames of 2.4 m to be passed in order.

    The forest is as dense as `forest`. A gate stands across the mean direction of the legs before and behind it, with
    4 m free of trees on both sides. The mission passes all of them and ends 8 m behind the last.

    Args:
        seed: same seed, same course.
        gates: number of gates.
        ground: True adds the ground, a box whose top is z = 0.
    """
    rng = np.random.default_rng(seed)
    places = [np.array(START)]
    for _ in range(gates):
        heading = np.radians(rng.uniform(-_TURN, _TURN))
        if abs(places[-1][1]) > _BESIDE:
            heading = -np.sign(places[-1][1]) * abs(heading)
        step = rng.uniform(*_SPACING) * np.array([np.cos(heading), np.sin(heading)])
        places.append(np.array([*(places[-1][:2] + step), rng.uniform(*_HEIGHTS)]))
    goal = places[-1] + np.array([8.0, 0.0, 0.0])
    goal[2] = START[2]
    legs = np.diff([*places, goal], axis=0)[:, :2]
    legs /= np.linalg.norm(legs, axis=1, keepdims=True)
    headings = np.arctan2(*(legs[:-1] + legs[1:]).T[::-1])
    frames: list[Obstacle] = [{"boxes": _frame(place, yaw)} for place, yaw in zip(places[1:], headings, strict=True)]
    clear = np.concatenate(
        [places[:1], goal[None], *(_run(p, yaw) for p, yaw in zip(places[1:], headings, strict=True))]
    )
    sides = np.array(places)[:, 1]
    area = ((2.5, goal[0] - 2.5), (sides.min() - _LANE, sides.max() + _LANE))
    count = round(_TREES_PER_AREA * (area[0][1] - area[0][0]) * (area[1][1] - area[1][0]))
    draw = partial(tree, rng, 15.0, area)
    trees = []
    while len(trees) < count:
        plant = draw()
        if all(np.all(DISTANCES[table](clear[:, None], rows) >= OPENING) for table, rows in plant.items()):
            trees.append(plant)
    waypoints = [Waypoint(as_position(place), radius=0.5 * OPENING) for place in places[1:]]
    end = as_position(goal)
    world = field_world(f"course-{gates}-{seed}", [*frames, *trees], ground=ground, goal=end)
    return world.with_mission(Mission((*waypoints, Waypoint(end, stop=True))))


def _frame(place: Rows, yaw: float) -> Rows:
    """Return the four bars [4, 7] of a gate around a place [m], across the heading `yaw`."""
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    offset, outer = 0.5 * (OPENING + _FRAME), OPENING + 2.0 * _FRAME
    bars = [[*(place + side * offset * across), _FRAME, _FRAME, outer, yaw] for side in (-1.0, 1.0)]
    bars += [[*place[:2], place[2] + side * offset, _FRAME, OPENING, _FRAME, yaw] for side in (-1.0, 1.0)]
    return np.array(bars)


def _run(place: Rows, yaw: float) -> Rows:
    """Return places along the free run through a gate [n, 3]."""
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return place + np.linspace(-_RUN, _RUN, 9)[:, None] * along
