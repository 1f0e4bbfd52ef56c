"""The plans being flown: which control belongs to which time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.plan import PlanStatus

__all__ = ["PlanSchedule", "ScheduledPlan"]

_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class ScheduledPlan:
    """Controls over time."""

    number: int
    """Counts the plans."""
    measured: float
    """When the state was measured on which the plan builds, host time [s]."""
    time: float
    """When its first control begins, host time [s]."""
    dt: float
    """Length of a step [s]."""
    controls: NDArray[np.float64]
    """Thrust [N] and body rates [rad/s], shape [N, 4], finite."""
    status: PlanStatus

    def command(self, now: float) -> NDArray[np.float64] | None:
        """Return the control of step floor((now - time) / dt), shape [4]; None before the first and after the last."""
        step = math.floor((now - self.time) / self.dt + _ROUNDING)
        return self.controls[step] if 0 <= step < len(self.controls) else None


class PlanSchedule:
    """The newest plan, and those before it that are flown until it begins.

    Replaced whole by one thread and read by others.
    """

    def __init__(self) -> None:
        self._plans: tuple[ScheduledPlan, ...] = ()

    @property
    def newest(self) -> ScheduledPlan | None:
        """The newest plan."""
        return self._plans[0] if self._plans else None

    def append(self, plan: ScheduledPlan, now: float) -> None:
        """Add a plan, and forget those that nobody needs who asks for `now` [s] or later."""
        kept = [plan]
        for older in self._plans:
            kept.append(older)
            if older.time <= now:
                break
        self._plans = tuple(kept)

    def at(self, now: float) -> ScheduledPlan | None:
        """Return the newest plan that has begun and has not ended at `now` [s]."""
        return next((plan for plan in self._plans if plan.command(now) is not None), None)

    def command(self, now: float) -> NDArray[np.float64] | None:
        """Return the control to fly at `now` [s], shape [4]; None when no plan reaches so far."""
        plan = self.at(now)
        return None if plan is None else plan.command(now)

    def ahead(self, now: float, *, period: float, count: int, age_max: float) -> NDArray[np.float64]:
        """Return the controls to fly at `now` + `period`, `now` + 2 `period`, .. [s], shape [n, 4], n <= `count`.

        It ends where no plan reaches, or where the state on which it builds will be older than `age_max` [s].
        """
        controls = np.empty((count, 4))
        for i in range(count):
            time = now + (i + 1) * period
            plan = self.at(time)
            if plan is None or time - plan.measured > age_max:
                return controls[:i]
            controls[i] = plan.command(time)
        return controls
