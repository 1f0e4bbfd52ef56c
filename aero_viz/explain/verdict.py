"""One sentence on why an instance was flown or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import PlanStatus
from aero_viz.explain.evidence import Evidence
from aero_viz.explain.terms import STAGE2, step_times
from aero_viz.scenes import World

Array = NDArray[np.float64]
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
    time = (step + 1) * evidence.frame.config.sampling.dt
    return float(distance.min()), time, _nearest_name(evidence, position, time)


def _nearest_name(evidence: Evidence, position: Array, time: float) -> str:
    """Return the name of the obstacle that is nearest to a position [m], [3], at a time in the plan [s]."""
    obstacles = evidence.problem.obstacles
    speed = obstacles.speed_of_nearest(position, time)
    if speed is None:
        return obstacle_name(evidence.frame.world, obstacles.nearest_point(position))
    return f"an obstacle that moves at {speed:.1f} m/s"


def verdict(evidence: Evidence, instance: int) -> str:
    """Return the reason why the planner chose an instance or rejected it."""
    plan, best = evidence.plan, int(evidence.plan.best)
    if plan.status == PlanStatus.STALE_CLOUD:
        return "The cloud is too old: the drone brakes, whatever the candidates cost."
    if plan.status == PlanStatus.NO_SAFE_CANDIDATE:
        prefers_safe = evidence.frame.config.candidates.prefer_safe
        cause = "No candidate is safe" if prefers_safe else "The cheapest candidate is not safe"
        flown = f"{cause}: the drone stops; the stop has replaced instance {best}."
        if plan.kinds[best] != "brake":
            flown = f"{cause}: the drone flies instance {best}, whose stop keeps the largest clearance."
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
    if not evidence.has_stop[instance]:
        c, limit = evidence.frame.config.candidates, evidence.frame.config.vehicle.speed_limit
        speed = float(np.linalg.norm(evidence.plan.velocities[instance, 0]))
        # The planner measures no clearance above what is asked at the speed limit.
        is_too_fast = c.safe_clearance + c.speed_margin * (limit - speed) < evidence.safety.clear_stop
        stop = "no stop that leaves it stays clear, in space that is seen"
        reasons.append(_too_fast(evidence, instance) if is_too_fast else stop)
    if evidence.safety.nearest[instance] < evidence.safety.safe_clearance:
        reasons += _too_near(evidence, instance)
    return f"Instance {instance} is unsafe: {', and '.join(dict.fromkeys(reasons))}."


def _too_near(evidence: Evidence, instance: int) -> list[str]:
    """Return where an instance lacks the most clearance, which the planner measures less a margin for the speed."""
    config, plan = evidence.frame.config, evidence.plan
    positions, velocities = (array[instance].astype(np.float64) for array in (plan.positions, plan.velocities))
    places, speeds = positions[1:], np.linalg.norm(velocities, axis=-1)
    times = step_times(places, config)
    asked = speeds[1:]
    if config.candidates.between_steps:
        places = np.concatenate((places, 0.5 * (positions[:-1] + positions[1:])))
        asked = np.concatenate((asked, speeds[:-1]))
        times = np.concatenate((times, times - 0.5 * config.sampling.dt))
    asked = evidence.safety.safe_clearance + config.candidates.speed_margin * asked
    distances = evidence.problem.obstacles.distance(places, times)
    at = int((distances - asked).argmin())
    is_asked = config.candidates.prove_stop != "instead"  # otherwise it may come close beyond its stop
    if distances[at] >= asked[at]:
        return [_too_fast(evidence, instance)] if is_asked else []
    text = f"it comes within {distances[at]:.2f} m of {_nearest_name(evidence, places[at], float(times[at]))}"
    rest = f", where {asked[at]:.2f} m are asked" if is_asked else ""
    return [f"{text} at {times[at]:.2f} s{rest}"]


def _too_fast(evidence: Evidence, instance: int) -> str:
    speed = float(np.linalg.norm(evidence.plan.velocities[instance], axis=-1).max())
    limit = evidence.frame.config.vehicle.speed_limit
    return f"at {speed:.1f} m/s, above the speed limit of {limit:g} m/s, no clearance counts as enough"


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
