"""The plans being flown: which control applies at which time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner.onboard.braking_path import BrakingPath
from aero_planner.plan import PlanStatus

_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class ScheduledPlan:
    """The controls of one plan over time."""

    number: int
    """Counts the plans."""
    measured: float
    """Time at which the state of the plan was measured, host time [s]."""
    time: float
    """Start of the first control, host time [s]."""
    dt: float
    """Time step [s]."""
    controls: NDArray[np.float64]
    """Thrust [N] and body rates [rad/s], shape [N, 4], finite."""
    status: PlanStatus
    path: BrakingPath | None = None
    """Braking path."""

    def command(self, now: float) -> NDArray[np.float64] | None:
        """Return the control of step floor((now - time) / dt), shape [4]; None outside the plan's horizon."""
        step = math.floor((now - self.time) / self.dt + _ROUNDING)
        return self.controls[step] if 0 <= step < len(self.controls) else None


class PlanSchedule:
    """The newest plan and the earlier ones that are flown until it begins.

    One thread appends; any thread may read, because the plans are replaced as a whole.
    """

    def __init__(self) -> None:
        self._plans: tuple[ScheduledPlan, ...] = ()

    def __len__(self) -> int:
        return len(self._plans)

    def append(self, plan: ScheduledPlan, now: float) -> None:
        """Add a plan and discard those that are not needed at `now` [s] or later."""
        kept = [plan]
        for older in self._plans:
            kept.append(older)
            if older.time <= now:
                break
        self._plans = tuple(kept)

    def path(self, since: float) -> BrakingPath | None:
        """Return the newest plan's braking path; None if there is none, or if its state is from before `since` [s]."""
        return self._plans[0].path if self._plans and self._plans[0].measured >= since else None

    def at(self, now: float) -> ScheduledPlan | None:
        """Return the newest plan whose horizon includes `now` [s]."""
        return next((plan for plan in self._plans if plan.command(now) is not None), None)

    def command(self, now: float) -> NDArray[np.float64] | None:
        """Return the control at `now` [s], shape [4]; None if no plan covers that time."""
        plan = self.at(now)
        return None if plan is None else plan.command(now)

    def upcoming(self, now: float, *, period: float, count: int, age_max: float) -> NDArray[np.float64]:
        """Return the controls at `now` + `period`, `now` + 2 `period`, .. [s], shape [n, 4], n <= `count`.

        The list ends where no plan applies, or where the state on which the plan is based is older than `age_max` [s].
        """
        controls = np.empty((count, 4))
        for i in range(count):
            time = now + (i + 1) * period
            plan = self.at(time)
            if plan is None or time - plan.measured > age_max:
                return controls[:i]
            controls[i] = plan.command(time)
        return controls
