"""One sentence on why an instance was flown or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlanStatus, registry
from aero_planner.costs import CostTerm
from aero_viz.cost_text import cost_text
from aero_viz.explain.evidence import Evidence
from aero_viz.explain.visibility import sight_of
from aero_viz.scenes import World

Array = NDArray[np.float64]
_ON_SURFACE = 0.3
"""Distance up to which a point of the cloud belongs to a solid of the world: noise and drift [m]."""
_REFUSALS = {
    "stop_proof": "no stop that leaves it stays clear, in space that is seen",
    "moving_obstacles": "it flies along beside a moving obstacle and hardly comes nearer to the goal",
}
"""Reason for which an instance may not be flown, by the stage that says so."""
_AT_END = {
    "blocked_path": ": beyond its end, the way to the goal is blocked",
    "escape": ": it ends near places where no progress was made",
}
"""Where a difference arises, by the name of a terminal term."""
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
    time = (step + 1) * evidence.frame.config.sampling.dt
    return float(distance.min()), time, _nearest_name(evidence, position, time)


def _nearest_name(evidence: Evidence, position: Array, time: float) -> str:
    """Return the name of the obstacle that is nearest to a position [m], [3], at a time in the plan [s]."""
    obstacles = evidence.obstacles
    speed = obstacles.speed_of_nearest(position, time)
    if speed is None:
        return obstacle_name(evidence.frame.world, obstacles.nearest_point(position))
    return f"an obstacle that moves at {speed:.1f} m/s"


def _out_of_sight(evidence: Evidence, position: Array, time: float) -> str:
    """Return why the sensor does not see the obstacle that is nearest to a position, with a comma; empty if it does."""
    place = evidence.obstacles.nearest_point(position)
    if place is None or evidence.obstacles.speed_of_nearest(position, time) is not None:
        return ""
    words = sight_of(evidence.frame, np.asarray(place, dtype=np.float64))
    return f", which is remembered and now {words}," if words else ""


def verdict(evidence: Evidence, instance: int) -> str:
    """Return the reason why the planner chose an instance or rejected it."""
    plan, best = evidence.plan, int(evidence.plan.best)
    if plan.status == PlanStatus.STALE_CLOUD:
        return "The cloud is too old: the drone brakes, whatever the candidates cost."
    if plan.status == PlanStatus.NO_SAFE_CANDIDATE:
        prefers_safe = evidence.frame.config.prefers_safe
        cause = "No candidate is safe" if prefers_safe else "The cheapest candidate is not safe"
        flown = f"{cause}: the drone stops; the stop has replaced instance {best}."
        if plan.kinds[best] != "brake":
            flown = f"{cause}, and no stop is clear: the drone flies instance {best}, whose stop is the widest."
        return flown if instance == best else f"{flown} {_unsafe(evidence, instance)}"
    if instance == best:
        return _won(evidence)
    if evidence.frame.config.prefers_safe and evidence.is_safe[best] and not evidence.is_safe[instance]:
        difference = float(plan.stage2_cost[instance] - plan.stage2_cost[best])
        cost = f"It costs {cost_text(abs(difference))} {'more' if difference > 0.0 else 'less'} than {best}."
        return f"{_unsafe(evidence, instance)} {cost}"
    return f"Instance {instance} lost to {best}: {_difference(evidence, instance, best)}."


def _won(evidence: Evidence) -> str:
    best, cost = int(evidence.plan.best), np.array(evidence.plan.stage2_cost, dtype=np.float64)
    rivals = np.flatnonzero(evidence.is_safe | (not evidence.frame.config.prefers_safe))
    rivals = rivals[rivals != best]
    if not len(rivals):
        return f"Instance {best} won: no other one is safe."
    second = int(rivals[cost[rivals].argmin()])
    return f"Instance {best} won against {second}, which costs {_difference(evidence, second, best)}."


def _unsafe(evidence: Evidence, instance: int) -> str:
    """Return why an instance counts as unsafe."""
    if evidence.is_safe[instance]:
        return f"Instance {instance} is safe."
    safety = evidence.safety
    reasons = [_refusal(stage) for stage, refused in safety.refused_by.items() if refused[instance]]
    if not safety.keeps_clearance[instance]:
        # Where a stage has refused it, it is the stage that matters, and the clearance is another fact.
        reasons += _too_near(evidence, instance, is_asked=not reasons)
    return f"Instance {instance} is unsafe: {', and '.join(reasons)}."


def _refusal(stage: str) -> str:
    """Return why a stage does not admit an instance."""
    return _REFUSALS.get(stage, f"the stage {registry.load_stage(stage).label} does not admit it")


def _too_near(evidence: Evidence, instance: int, *, is_asked: bool) -> list[str]:
    """Return where an instance lacks the most clearance, and how much was asked there."""
    plan, config = evidence.plan, evidence.frame.config
    step = int(evidence.safety.clearance[instance].argmin())
    speed = float(np.linalg.norm(plan.velocities[instance, step + 1]))
    asked = evidence.safety.demanded_clearance + config.candidates.speed_margin * speed
    distance, time = float(evidence.distance[instance, step]), float(evidence.times[step])
    if distance >= asked:  # the planner measures no farther than it asks for at the speed limit
        limit = config.vehicle.speed_limit
        text = f"at {speed:.1f} m/s, above the speed limit of {limit:g} m/s, no clearance counts as enough"
        return [text] if is_asked else []
    position = np.asarray(plan.positions[instance, step + 1], dtype=np.float64)
    text = f"it comes within {distance:.2f} m of {_nearest_name(evidence, position, time)}"
    text += _out_of_sight(evidence, position, time)
    rest = f", where {asked:.2f} m are asked" if is_asked else ""
    return [f"{text} at {time:.2f} s{rest}"]


def _difference(evidence: Evidence, instance: int, best: int) -> str:
    """Return the terms by which an instance costs more, such as "412 more for obstacles between 0.60 and 0.90 s"."""
    costs = evidence.stage2
    gap = costs.values[instance].astype(np.float64) - costs.values[best]
    by_term = gap.sum(axis=1)
    row = int(by_term.argmax())
    term, total, largest = costs.terms[row], float(by_term.sum()), float(by_term[row])
    cause = f"{cost_text(largest)} more for {term.label}{_when(evidence, instance, gap[row], term)}"
    return cause if abs(total - largest) < 0.05 * abs(total) else f"{cost_text(total)} more in all, {cause}"


def _when(evidence: Evidence, instance: int, gap: Array, term: CostTerm) -> str:
    """Return the steps of the plan in which the difference arises."""
    if term.terminal is not None:
        return _AT_END.get(term.name, " at its end")
    steps = np.flatnonzero(gap >= _SHARE * gap.max())
    if not len(steps):
        return ""
    dt, first, last = evidence.frame.config.sampling.dt, int(steps[0]), int(steps[-1])
    span = f" between {first * dt:.2f} and {(last + 1) * dt:.2f} s"
    if term.obstacle is None:
        return span
    distance, _, obstacle = closest(evidence, instance, slice(first, last + 1))
    return f"{span}, {distance:.2f} m from {obstacle}"
