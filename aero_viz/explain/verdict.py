"""One sentence on why an instance was flown or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from aero_planner import PlanStatus
from aero_viz.explain.evidence import Evidence
from aero_viz.explain.terms import STAGE2
from aero_viz.scenes import World

_ON_SURFACE = 0.3
"""Distance up to which a point of the cloud belongs to a solid of the world: noise and drift [m]."""
_SHARE = 0.1
"""Share of the largest difference from which a step counts as one where two instances differ."""


def obstacle_name(world: World | None, point: ArrayLike | None) -> str:
    """Return the name of the solid on whose surface a point of the cloud [m], [3], lies; None is the ground."""
    if point is None:
        return "the ground"
    distance, name = (np.inf, "") if world is None else world.nearest(point)
    return name if abs(distance) < _ON_SURFACE else "a point of the cloud"


def closest(evidence: Evidence, instance: int, steps: slice = slice(None)) -> tuple[float, float, str]:
    """Return the least distance of an instance to an obstacle [m], its time in the plan [s] and the obstacle's name."""
    distance = evidence.distance[instance, steps]
    step = int(distance.argmin()) + (steps.start or 0)
    position = np.asarray(evidence.plan.positions[instance, step + 1], dtype=np.float64)
    obstacles, time = evidence.problem.obstacles, (step + 1) * evidence.frame.config.sampling.dt
    speed = obstacles.speed_of_nearest(position, time)
    if speed is None:
        name = obstacle_name(evidence.frame.world, obstacles.nearest_point(position))
    else:
        name = f"an obstacle that moves at {speed:.1f} m/s"
    return float(distance.min()), time, name


def verdict(evidence: Evidence, instance: int) -> str:
    """Return the reason why the planner chose an instance or rejected it."""
    plan, best = evidence.plan, int(evidence.plan.best)
    if plan.status == PlanStatus.STALE_CLOUD:
        return "The cloud is too old: the drone brakes, whatever the candidates cost."
    if plan.status == PlanStatus.NO_SAFE_CANDIDATE:
        flown = f"No candidate is safe: the drone flies a stop in place of instance {best}."
        if plan.kinds[best] != "brake":
            flown = f"No candidate is safe: the drone flies instance {best}, whose stop keeps the largest clearance."
        return flown if instance == best else f"{flown} {_unsafe(evidence, instance)}"
    if instance == best:
        return _won(evidence)
    if evidence.frame.config.candidates.prefer_safe and evidence.is_safe[best] and not evidence.is_safe[instance]:
        difference = float(plan.stage2_cost[instance] - plan.stage2_cost[best])
        cost = f"It costs {_number(abs(difference))} {'more' if difference > 0.0 else 'less'} than {best}."
        return f"{_unsafe(evidence, instance)} {cost}"
    return f"Instance {instance} lost to {best}: {_difference(evidence, instance, best)}."


def _won(evidence: Evidence) -> str:
    best, cost = int(evidence.plan.best), np.array(evidence.plan.stage2_cost, dtype=np.float64)
    rivals = np.flatnonzero(evidence.is_safe | (not evidence.frame.config.candidates.prefer_safe))
    rivals = rivals[rivals != best]
    if not len(rivals):
        return f"Instance {best} won: no other one is safe."
    second = int(rivals[cost[rivals].argmin()])
    return f"Instance {best} won against {second}, which costs {_difference(evidence, second, best)}."


def _unsafe(evidence: Evidence, instance: int) -> str:
    """Return why an instance counts as unsafe."""
    if evidence.is_safe[instance]:
        return f"Instance {instance} is safe."
    reasons = []
    if evidence.stop_clearance is not None:
        reasons.append("no stop that leaves it stays clear, in space that is seen")
    if evidence.nearest[instance] < evidence.safe_clearance:
        distance, time, name = closest(evidence, instance)
        reasons.append(f"it comes within {distance:.2f} m of {name} at {time:.2f} s")
    return f"Instance {instance} is unsafe: {', and '.join(reasons)}."


def _difference(evidence: Evidence, instance: int, best: int) -> str:
    """Return the terms by which an instance costs more, such as "412 more for obstacles between 0.60 and 0.90 s"."""
    gap = evidence.terms[:, instance] - evidence.terms[:, best]
    by_term = gap.sum(axis=1)
    term = int(by_term.argmax())
    name, total, largest = STAGE2[term], float(by_term.sum()), float(by_term[term])
    cause = f"{_number(largest)} more for {name}{_when(evidence, instance, gap[term], name)}"
    return cause if abs(total - largest) < 0.05 * abs(total) else f"{_number(total)} more in all, {cause}"


def _when(evidence: Evidence, instance: int, gap: np.ndarray, name: str) -> str:
    """Return the steps of the plan in which the difference arises."""
    dt, c = evidence.frame.config.sampling.dt, evidence.frame.config.costs
    if name == "blocked path":
        return f": beyond its end, the way to the goal is blocked within {c.blocked_range:g} m"
    if name == "escape":
        return ": it ends near places where no progress was made"
    steps = np.flatnonzero(gap >= _SHARE * gap.max())
    if not len(steps):
        return ""
    first, last = int(steps[0]), int(steps[-1])
    span = f" between {first * dt:.2f} and {(last + 1) * dt:.2f} s"
    if name != "obstacles":
        return span
    distance, _, obstacle = closest(evidence, instance, slice(first, last + 1))
    return f"{span}, {distance:.2f} m from {obstacle}"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 10.0 else f"{value:.2g}"
