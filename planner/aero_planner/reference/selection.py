"""Stage II: the optimised controls are rolled out once more, and the instance with the lowest S2 is flown."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.costs import J_col, J_goal
from aero_planner.reference.dynamics import State
from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})


@wp.kernel
def stage2_cost(
    goal: State, c: Parameters, states: wp.array3d(dtype=State), distance: wp.array3d(dtype=float),
    goal_cost: wp.array(dtype=float), collision_cost: wp.array(dtype=float), S2: wp.array(dtype=float),
):  # fmt: skip
    """Write J_goal, J_col and S2 = J_goal + J_col of every instance. Launched over [M]."""
    m = wp.tid()
    goal_cost[m] = 0.0
    collision_cost[m] = 0.0
    for t in range(distance.shape[2]):
        goal_cost[m] += J_goal(states[m, 0, t + 1], goal, c)
        collision_cost[m] += J_col(distance[m, 0, t], c)
    S2[m] = goal_cost[m] + collision_cost[m]


@wp.kernel
def select_instance(S2: wp.array(dtype=float), best: wp.array(dtype=int)):
    """Write argmin_m S2. Launched over [1]."""
    best[0] = 0
    for m in range(S2.shape[0]):
        if S2[m] < S2[best[0]]:
            best[0] = m
