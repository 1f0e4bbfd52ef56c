"""Which candidates of a frame are known to be unsafe, also where a frame holds a plan and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlanStatus

if TYPE_CHECKING:
    from aero_viz.session.frame import Frame


def known_safe(frame: Frame) -> NDArray[np.bool_]:
    """Return False for each candidate that is unsafe as far as a frame tells, shape [M].

    Of a frame without `is_safe`, such as that of a drone, only the choice tells something: with prefer_safe, candidates
    that cost less than the chosen one were unsafe, and without a safe candidate all were.
    """
    if frame.is_safe is not None:
        return frame.is_safe
    plan = frame.plan
    is_safe = np.ones(len(plan.kinds), dtype=np.bool_)
    if frame.config.prefers_safe and plan.status == PlanStatus.OK:
        is_safe &= plan.cost >= plan.cost[int(plan.best)]
    elif frame.config.prefers_safe and plan.status == PlanStatus.NO_SAFE_CANDIDATE:
        is_safe[:] = False
    is_safe[int(plan.best)] = plan.status == PlanStatus.OK
    return is_safe
