"""What the choices of two configurations cost at one tick, each by the weights of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aero_planner import PlannerConfig
from aero_planner.cost_terms import CostTerms
from aero_viz.explain.evidence import Replanner
from aero_viz.session.frame import Frame


@dataclass(frozen=True)
class ChoiceCost:
    """S2 of a choice, and its parts."""

    s2: float
    goal: float
    collision: float

    @property
    def rest(self) -> float:
        """All other terms."""
        return self.s2 - self.goal - self.collision


@dataclass(frozen=True, eq=False)
class CrossedCosts:
    """Costs of the choices of A and B, in this order, by the configuration of each."""

    a: Frame
    b: Frame
    by_a: tuple[ChoiceCost, ChoiceCost]
    by_b: tuple[ChoiceCost, ChoiceCost]


def crossed_costs(replan: Replanner, a: Frame, b: Frame) -> CrossedCosts | None:
    """Return the costs of the choices of two frames of one tick; None if AERO-MPPI has not made both,
    or if one cannot be flown by the other's model."""
    if not isinstance(a.config, PlannerConfig) or not isinstance(b.config, PlannerConfig):
        return None
    sections = [(config.sampling.steps, config.sampling.dt, config.vehicle.model) for config in (a.config, b.config)]
    if sections[0] != sections[1] or a.checkpoint is None or b.checkpoint is None:
        return None
    commands = np.stack([frame.plan.command for frame in (a, b)])
    by_a, by_b = (replan.costs(frame, commands) for frame in (a, b))
    return None if by_a is None or by_b is None else CrossedCosts(a, b, _choices(by_a), _choices(by_b))


def _choices(costs: CostTerms) -> tuple[ChoiceCost, ChoiceCost]:
    goal = [term.sum == "J_goal" for term in costs.terms]
    values = costs.values.sum(axis=2, dtype=np.float64)
    collision = costs.values_of("obstacles").sum(axis=1, dtype=np.float64)
    first, second = (
        ChoiceCost(float(row.sum()), float(row[goal].sum()), float(near))
        for row, near in zip(values, collision, strict=True)
    )
    return first, second
