"""Add a cost inside the planner, in Stage I and Stage II: here, a preference for a height of 1 m.

The term has its slider, flag and bar in every command of aero-viz, such as `own_cost_term.py demo random_clutter` or
`own_cost_term.py fly forest --height.q-height 30`. Without a command, flights with and without the term are compared.
"""

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import aero_planner
import aero_viz.flight
from aero_planner import registry
from aero_planner.costs import CostTerm, Step
from aero_planner.parameters import ParameterSection, live
from aero_viz.cli import main
from aero_viz.scenes import scene


@dataclass(frozen=True)
class Height(ParameterSection, section="height"):
    """A height to keep."""

    q_height: float = live(0.0, "1/m", 0.0, 1e3, "Weight of the distance from that height.", label="Height weight")
    kept_height: float = live(1.0, "m", -1e3, 1e3, "Height to keep, world frame.", label="Height to keep")


@wp.func
def height_cost(s: Step, c: Any) -> float:
    """Return the cost of a time step with the state s; c holds the live parameters by name."""
    return c.q_height * wp.abs(s.p[2] - c.kept_height)


term = CostTerm("height", "height to keep", running=height_cost, parameters=Height)
registry.add("cost_terms", "height", term)  # before the configuration is made


def compare() -> None:
    """Fly with and without the term."""
    for weight in (0.0, 100.0):
        planner = aero_planner.Planner(aero_planner.PlannerConfig().replace({"height.q_height": weight}), seed=1)
        source = aero_viz.flight.FlightSource(scene("random_clutter", seed=2), seed=1)
        heights, costs = [], []
        while source.outcome is None:
            seen = source.observe()
            plan = seen.plan_with(planner)
            terms = planner.cost_terms([int(plan.best)])
            costs.append(terms.values[0, terms.terms.index(term)].sum())  # of the N time steps
            heights.append(np.asarray(seen.state.position)[2])
            source.advance(plan)
        off = np.abs(np.array(heights) - 1.0).mean()
        print(f"weight {weight:3g}: {source.outcome}, {off:.2f} m off the height, at a cost of {np.mean(costs):.0f}")


if __name__ == "__main__":
    main() if sys.argv[1:] else compare()
