"""The stage that leads out of dead ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import warp as wp

from aero_planner.array_memory import array
from aero_planner.costs import CostTerm
from aero_planner.recorder import Recorder
from aero_planner.stage import Hooks, Launches, Stage
from aero_planner.stages.way_out.places import (
    PLACES,
    Places,
    escape_cost,
    look_around,
    look_at_goal,
    remember_place,
)


@dataclass(eq=False)
class Arrays:
    """The tabu memory."""

    places: wp.array = array(wp.vec3, f"B {int(PLACES)}", "m", "Places without progress, world frame.", kept="plans")
    place_count: wp.array = array(wp.int32, "B", "", "Number of places remembered for the goal.", kept="plans")
    place_goal: wp.array = array(
        wp.vec3, "B", "m", "Goal for which they are remembered, world frame.", kept="plans", initial=math.inf
    )
    place_nearest: wp.array = array(
        wp.float32, "B", "m", "Distance to the goal when progress was last made; 0 after an arrival.", kept="plans"
    )
    place_idle: wp.array = array(
        wp.float32, "B", "s", "Time since then, or since a place was remembered.", kept="plans"
    )
    goal_hidden: wp.array = array(
        wp.int32, "B", "", "Directions from which the goal was behind a surface, as bits.", kept="plans"
    )
    nearest_place: wp.array = array(wp.vec3, "B", "m", "Where the drone was nearest to the goal.", kept="plans")


def _remember(r: Recorder) -> list[list[Launches]]:
    inputs = [r.problem, r.params, r.previous]
    outputs = [r.view("way_out"), r.stage_arrays("way_out").nearest_place]
    return [[[r.record(remember_place, (r.sizes.B,), inputs=inputs, outputs=outputs)]]]


def _look(r: Recorder) -> list[list[Launches]]:
    inputs = [r.problem, r.params, r.cells]
    launch = r.record(look_at_goal, (r.sizes.B,), inputs=inputs, outputs=[r.view("way_out")])
    return [[[launch]]]


STAGE = Stage(
    name="way_out",
    label="Way out",
    arrays=Arrays,
    view=Places,
    hooks=Hooks(spread=look_around),
    terms=(CostTerm("escape", "escape", terminal=escape_cost),),
    launches={"start": _remember, "rollouts": _look},
)
