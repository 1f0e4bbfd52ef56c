"""The goal of the flight, as given at the start or received over the link."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.failsafe_conditions import is_inside_fence
from aero_planner.onboard.settings import LimitSettings

_log = logging.getLogger(__name__)


class GoalTracker:
    """Keeps the newest goal that lies inside the geofence, whose heights count from the ground.

    The goal is checked again when the height of the ground becomes known. If it then lies outside, there is no goal.
    Later the height may be that of a roof below the drone, which tells nothing about the goal.

    Args:
        limits: Settings of the geofence.
        goal: The first goal [m], shape [3], world frame; None if there is none yet. Outside the heights above the local
            origin it waits until the height of the ground is known.

    Raises:
        ValueError: The goal is not three finite numbers, or lies outside the geofence at any height of the ground.

    Attributes:
        goal: The present goal [m], shape [3], world frame; None if there is none.
        count: Number of goals accepted over the link.
    """

    def __init__(self, limits: LimitSettings, goal: ArrayLike | None) -> None:
        self.goal: NDArray[np.float64] | None = None
        self.count = 0
        self._limits = limits
        self._first = None if goal is None else np.array(goal, dtype=np.float64)
        self._received: NDArray[np.float64] | None = None
        self._is_accepted = False
        self._is_ground_known = False
        if self._first is not None:
            self._check_first(self._first)

    def update(self, goal: NDArray[np.float64] | None, *, ground: float | None = None) -> None:
        """Accept the newest goal of the link, and check the present one; one outside the fence is refused.

        If a new goal is refused, the present one is kept. A refused goal that is sent again is checked again, since the
        ground may be known better by then. Sending the accepted goal again changes nothing.

        Args:
            goal: The last goal received [m], shape [3], world frame: a new array for each message.
            ground: Height of the ground, world frame [m]; None while it is unknown, and the heights of the fence
                count from the local origin.
        """
        if goal is not None and goal is not self._received:
            self._receive(goal, ground)
        if ground is not None and not self._is_ground_known:
            self._check_again(ground)
        self._is_ground_known = ground is not None

    def _check_first(self, goal: NDArray[np.float64]) -> None:
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"the goal is {goal.tolist()}; it must be three finite numbers [m].")
        if not is_inside_fence([*goal[:2], self._limits.fence_height_min], self._limits):
            raise ValueError(f"the goal {goal.tolist()} lies outside the geofence; correct it or limits.fence_*.")
        if is_inside_fence(goal, self._limits):
            self.goal = goal
        else:
            _log.warning("the goal %s waits until the height of the ground is known: %s", *self._describe(goal, None))

    def _receive(self, goal: NDArray[np.float64], ground: float | None) -> None:
        is_repeated = self._received is not None and np.array_equal(goal, self._received, equal_nan=True)
        self._received = goal
        if is_repeated and self._is_accepted:
            return
        self._is_accepted = is_inside_fence(goal, self._limits, ground=ground or 0.0)
        if self._is_accepted:
            self._accept(goal)
            self.count, self._first = self.count + 1, None
        elif not is_repeated:
            self._log_refusal(goal, ground)

    def _check_again(self, ground: float) -> None:
        """Check the present goal, or the first one if there is none, with the height of the ground [m]."""
        goal = self._first if self.goal is None else self.goal
        if goal is None:
            return
        is_inside = is_inside_fence(goal, self._limits, ground=ground)
        if is_inside and self.goal is None:
            self._accept(goal)
        elif not is_inside:
            self._log_refusal(goal, ground)
            self.goal, self._is_accepted = None, False

    def _accept(self, goal: NDArray[np.float64]) -> None:
        self.goal = np.array(goal, dtype=np.float64)
        _log.info("the goal is %s", np.round(self.goal, 2).tolist())

    def _log_refusal(self, goal: NDArray[np.float64], ground: float | None) -> None:
        _log.error(
            "the goal %s is refused: %s; send another goal, or correct --goal or limits.fence_*",
            *self._describe(goal, ground),
        )

    def _describe(self, goal: NDArray[np.float64], ground: float | None) -> tuple[list[float], str]:
        """Return the rounded goal and how it lies outside the geofence, for the log."""
        low, high, height = self._limits.fence_height_min, self._limits.fence_height_max, float(goal[2])
        where = "it lies outside the geofence"
        if not low <= height - (ground or 0.0) <= high:
            below = "the local origin" if ground is None else f"the ground, which is at a height of {ground:.2f} m"
            where += f", at {height - (ground or 0.0):.2f} instead of {low:g} to {high:g} m above {below}"
        return np.round(goal, 2).tolist(), where
