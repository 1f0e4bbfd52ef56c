"""The goal of the flight, as given at the start or received over the link."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.failsafe_table import is_inside_fence
from aero_planner.onboard.settings import LimitSettings

_log = logging.getLogger(__name__)


class GoalTracker:
    """Keeps the newest goal that lies inside the geofence.

    Args:
        limits: Settings of the geofence.
        goal: The first goal [m], shape [3], world frame; None if there is none yet.

    Raises:
        ValueError: The goal is not three finite numbers, or lies outside the geofence.

    Attributes:
        goal: The present goal [m], shape [3], world frame; None before the first.
        count: Number of goals accepted over the link.
    """

    def __init__(self, limits: LimitSettings, goal: ArrayLike | None) -> None:
        self.goal = None if goal is None else np.array(goal, dtype=np.float64)
        if self.goal is not None:
            if self.goal.shape != (3,) or not np.isfinite(self.goal).all():
                raise ValueError(f"the goal is {self.goal.tolist()}; it must be three finite numbers [m].")
            if not is_inside_fence(self.goal, limits):
                raise ValueError(
                    f"the goal {self.goal.tolist()} lies outside the geofence; correct it or limits.fence_*."
                )
        self.count = 0
        self._limits = limits
        self._received: NDArray[np.float64] | None = None
        self._is_accepted = False

    def update(self, goal: NDArray[np.float64] | None, *, ground: float = 0.0) -> None:
        """Accept the newest goal of the link; one outside the fence is refused and the present one is kept.

        A refused goal that is sent again is checked again, since the ground may be known better by then. Sending the
        accepted goal again changes nothing.

        Args:
            goal: The last goal received [m], shape [3], world frame: a new array for each message.
            ground: Height of the ground, world frame [m].
        """
        if goal is None or goal is self._received:
            return
        is_repeated = self._received is not None and np.array_equal(goal, self._received, equal_nan=True)
        self._received = goal
        if is_repeated and self._is_accepted:
            return
        self._is_accepted = is_inside_fence(goal, self._limits, ground=ground)
        if self._is_accepted:
            self.goal, self.count = np.array(goal, dtype=np.float64), self.count + 1
            _log.info("the goal is %s", np.round(self.goal, 2).tolist())
        elif not is_repeated:
            _log.error("the goal %s is refused: it lies outside the geofence", np.round(goal, 2).tolist())
