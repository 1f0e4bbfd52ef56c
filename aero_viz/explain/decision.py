"""What was decided at a tick: in a log what it holds, otherwise what the planner has chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aero_planner import PlanStatus
from aero_viz.session.frame import Frame


@dataclass(frozen=True)
class Decision:
    """Choice of a plan that was flown."""

    instance: int
    kind: str
    status: PlanStatus
    clearance: float
    """Smallest distance of the chosen rollout to what the planner knew, at most costs.distance_max [m]."""
    is_recorded: bool
    """True if a log holds it: then the plan of the frame was computed again, and may have chosen otherwise."""

    @classmethod
    def of(cls, frame: Frame) -> Decision:
        """Return the decision at the tick of a frame."""
        recorded, plan = frame.recorded_plan, frame.plan
        if recorded is not None:
            best, clearance = recorded.best, float(recorded.clearance[recorded.best])
            return cls(best, recorded.kinds[best], recorded.status, clearance, True)
        best = int(plan.best)
        status = PlanStatus(int(np.asarray(plan.status)))
        return cls(best, plan.kinds[best], status, float(plan.clearance[best].min()), False)
