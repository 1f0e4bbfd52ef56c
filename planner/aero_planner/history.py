"""The state that the planner carries from one plan to the next, as NumPy arrays."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.arrays import Workspace


@dataclass(frozen=True, eq=False)
class History:
    """State that the planner carries from one plan to the next."""

    controls: NDArray[np.float32]
    """Controls to fly of the previous plan, shape [B, N, 4]."""
    start_control: NDArray[np.float32]
    """Control in effect at its start, shape [B, 4]."""
    end: NDArray[np.float32]
    """Final position of its rollout [m], shape [B, 3], world frame."""
    waypoint: NDArray[np.float32]
    """Waypoint of its cost-to-go [m], shape [B, 3], world frame; NaN where the path led straight to the goal."""
    time: NDArray[np.float64]
    """Its stamp [s], shape [B]; NaN where there is no previous plan."""
    tick: NDArray[np.int32]
    """Number of plans so far, which selects the noise, shape [B]."""
    mean_disturbance: NDArray[np.float32]
    """Mean acceleration that the model does not explain [m/s^2], shape [B, 3], world frame."""
    drag_means: NDArray[np.float32]
    """Means of -a v and of v^2, the ratio of which is the drag; a is not explained by the model, shape [B, 2]."""
    view_quaternion: NDArray[np.float32]
    """Attitude at the previous plan, body to world, that lags by `view_age` on average, shape [B, 4]."""
    stop: NDArray[np.float32]
    """Controls of the stop that was proven last, shape [B, 2 N, 4]."""
    stop_age: NDArray[np.float32]
    """Time from the plan that proved it to the previous one [s], shape [B]; infinite where there is none."""
    places: NDArray[np.float32]
    """Places without progress [m], shape [B, 16, 3], world frame."""
    place_count: NDArray[np.int32]
    """Number of places remembered for the goal, shape [B]."""
    place_goal: NDArray[np.float32]
    """Goal for which they are remembered [m], shape [B, 3], world frame."""
    place_nearest: NDArray[np.float32]
    """Distance to the goal when progress was last made [m], shape [B]."""
    place_idle: NDArray[np.float32]
    """Time since then, or since a place was remembered [s], shape [B]."""

    @classmethod
    def from_workspace(cls, work: Workspace) -> History:
        """Return copies of the arrays of a workspace."""
        copies: list[Any] = [array.numpy().copy() for array in _arrays(work)]
        return cls(*copies)

    def fits(self, work: Workspace) -> bool:
        """Return True if the history is that of a workspace with as many drones and time steps."""
        return self.controls.shape == (*work.previous_controls.shape, 4)

    def write_to(self, work: Workspace) -> None:
        """Copy the history to the arrays of a workspace, which it must fit."""
        for array, field in zip(_arrays(work), dataclasses.fields(History), strict=True):
            array.assign(getattr(self, field.name))


def forget_history(work: Workspace) -> None:
    """Make the next plan the first one: without a previous plan, a proven stop or places without progress."""
    work.tick.zero_()
    work.previous_controls.zero_()
    work.previous_time.fill_(np.nan)
    work.proven_stop.zero_()
    work.proven_stop_age.fill_(np.inf)
    work.place_count.zero_()
    work.place_goal.fill_(wp.vec3(np.inf))


def _arrays(work: Workspace) -> list[wp.array]:
    """Return the arrays of a `History`, in the order of its fields."""
    return [
        work.previous_controls, work.previous_start_control, work.previous_end, work.previous_waypoint,
        work.previous_time, work.tick, work.mean_disturbance, work.drag_means, work.view_quaternion, work.proven_stop,
        work.proven_stop_age, work.places, work.place_count, work.place_goal, work.place_nearest, work.place_idle,
    ]  # fmt: skip
