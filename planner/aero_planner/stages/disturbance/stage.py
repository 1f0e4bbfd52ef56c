"""The stage that estimates disturbance and drag."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from aero_planner.array_memory import array
from aero_planner.stage import Hooks, Stage
from aero_planner.stages.disturbance.estimate import DisturbanceMeans, estimate


@dataclass(eq=False)
class Arrays:
    """State of the estimate."""

    mean_disturbance: wp.array = array(
        wp.vec3, "B", "m/s^2", "Mean acceleration that the model does not explain, world frame.", kept="plans"
    )
    drag_means: wp.array = array(
        wp.vec2, "B", "m^2/s^3, m^2/s^2", "Means of -a v, a being unexplained, and of v^2.", kept="plans"
    )


STAGE = Stage(
    name="disturbance",
    label="Disturbance and drag",
    arrays=Arrays,
    view=DisturbanceMeans,
    hooks=Hooks(estimate=estimate),
)
