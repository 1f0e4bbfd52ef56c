"""Add a cost to the choice between the instances of a plan: here, a preference for a height of 1 m.

A plan contains one optimised trajectory per instance, with its cost and clearance. This example adds a term to the cost
and flies the best instance among those that keep a safe distance. It needs no change of the planner, but the optimiser
itself does not see the term. A term inside the optimiser is one function in planner/aero_planner/kernels/costs.py and
one parameter in config/sections/costs.py, see CONTRIBUTING.md.
"""

import dataclasses

import numpy as np

from aero_planner import Plan, Planner, PlannerConfig, PlanStatus
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene

HEIGHT = 1.0  # [m]
SAFE_CLEARANCE = PlannerConfig().costs.distance_min  # d_min [m]


def height_cost(positions: np.ndarray) -> np.ndarray:
    """Return the mean deviation from HEIGHT of trajectories [m], shape [M, N+1, 3], as a cost of shape [M]."""
    return np.abs(positions[..., 2] - HEIGHT).mean(axis=-1)


def with_height_cost(plan: Plan, weight: float) -> Plan:
    """Return the plan with the best safe instance under the additional cost; a plan that brakes stays as it is."""
    is_safe = plan.clearance.min(axis=-1) >= SAFE_CLEARANCE
    if plan.status != PlanStatus.OK or not is_safe.any():
        return plan
    cost = np.where(is_safe, plan.stage2_cost + weight * height_cost(plan.positions), np.inf)
    return dataclasses.replace(plan, best=int(np.argmin(cost)))


for weight in (0.0, 200.0):
    planner = Planner(PlannerConfig(), seed=1)
    source = FlightSource(scene("random_clutter", seed=2), seed=1)
    heights = []
    while source.outcome is None:
        seen = source.observe()
        plan = seen.plan_with(planner)
        source.advance(with_height_cost(plan, weight))
        heights.append(np.asarray(seen.state.position)[2])
    deviation = np.abs(np.array(heights) - HEIGHT).mean()
    print(f"weight {weight:5g}: {source.outcome}, {deviation:.2f} m off the height on average")
