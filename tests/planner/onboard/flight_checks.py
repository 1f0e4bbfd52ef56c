"""What tests ask of a simulated flight: its states, its clearance, and that it flies as planned."""

import math
from collections.abc import Sequence

import numpy as np

from aero_planner.onboard.plan_schedule import ScheduledPlan
from tests.planner.onboard.simulated import CORRIDOR, Simulation

PERIOD = 0.02


def states(simulation: Simulation) -> list[str]:
    return [change.target.name for change in simulation.node.changes]


def since(simulation: Simulation, began: float, name: str) -> float:
    """Return the time from `began` until the state `name` was entered [s]."""
    changes = [change.time for change in simulation.node.changes if change.target.name == name]
    return next(time for time in changes if time >= began) - began


def clearance(simulation: Simulation, places: Sequence[tuple[float, float]] = CORRIDOR) -> float:
    path = np.array(simulation.path)[:, None, :2]
    return float(np.linalg.norm(path - np.array(places), axis=2).min()) - 0.25


def check_planned(flight: Simulation, seconds: float) -> None:
    """Fly for some time and check that each command is the planned control of its time."""
    plans: list[tuple[float, ScheduledPlan]] = []
    schedule = flight.node.schedule
    append = schedule.append

    def keep(plan: ScheduledPlan, now: float) -> None:
        plans.append((flight.now, plan))
        append(plan, now)

    schedule.append = keep  # type: ignore[method-assign]
    first = len(flight.link.sent)
    flight.run(seconds)
    checked = 0
    for now, command in flight.link.sent[first:]:
        begun = [plan for there, plan in plans if plan.time <= now and there < now]
        if not begun:
            continue
        plan = begun[-1]
        planned = plan.controls[math.floor((now - plan.time) / plan.dt + 1e-9)]
        np.testing.assert_allclose(command, planned)
        assert 0.0 <= now - plan.measured <= flight.node.config.limits.plan_age
        checked += 1
    assert checked >= 0.8 * seconds / PERIOD
    schedule.append = append  # type: ignore[method-assign]
