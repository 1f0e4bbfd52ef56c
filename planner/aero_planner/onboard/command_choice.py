"""The choice of the command that the control loop sends: from the plan, or to stop or hold the drone."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.braking_path import BrakingPath
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.failsafe_conditions import blind_time_left
from aero_planner.onboard.failsafe_process import takeover_time
from aero_planner.onboard.failsafe_table import AS_PLANNED, Inputs, Reaction, State
from aero_planner.onboard.plan_schedule import PlanSchedule
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.stop_controller import StopController
from aero_planner.onboard.watchdog import UPCOMING_MAX


class Command(NamedTuple):
    """A command as `CommandSink.send` takes it."""

    control: NDArray[np.float64]
    """Thrust [N] and body rates [rad/s], shape [4]."""
    attitude: NDArray[np.float64] | None
    """Attitude, body to world, w x y z, shape [4]; None for rates only."""


class CommandChoice:
    """Chooses commands for the reaction of the state machine. Called by the control loop only.

    Args:
        vehicle: Bounds of the commands.
        config: Configuration of the node.
        schedule: The plans being flown.
        stop: Controller that stops and holds the drone.
    """

    def __init__(
        self, vehicle: VehicleConfig, config: OnboardConfig, schedule: PlanSchedule, stop: StopController
    ) -> None:
        xy, z = vehicle.rate_xy_max, vehicle.rate_z_max
        self._bounds = (vehicle.thrust_min, -xy, -xy, -z), (vehicle.thrust_max, xy, xy, z)
        self._config, self._schedule, self._stop = config, schedule, stop
        self._hold: NDArray[np.float64] | None = None
        self._path: BrakingPath | None = None
        self._reset_time = -math.inf

    def forget_places(self, time: float) -> None:
        """Forget the position to hold and the braking paths from before `time` [s].

        The estimator was reset: in the new estimate, places have other coordinates.
        """
        self._hold, self._path, self._reset_time = None, None, time

    @property
    def path(self) -> BrakingPath | None:
        """Braking path: the one that is being followed, or the newest one; None if no cloud is known."""
        return self._path or self._schedule.path(self._reset_time)

    def choose(
        self,
        now: float,
        reaction: Reaction,
        state: State,
        inputs: Inputs,
        motion: MotionState | None,
        *,
        floor: float = -math.inf,
    ) -> Command | None:
        """Return the command to send at `now` [s]; None to send nothing. See `StopController` for the floor [m]."""
        limits = self._config.limits
        if reaction is not Reaction.HOLD:
            self._hold = None
        if reaction is not Reaction.BRAKE or state is State.READY:
            self._path = None
        elif self._path is None:
            self._path = self._schedule.path(self._reset_time)
        if reaction is Reaction.SILENT or motion is None:
            return None
        if reaction in AS_PLANNED and (planned := self._schedule.command(now)) is not None:
            return Command(np.clip(planned, *self._bounds), None)
        if reaction is Reaction.HOLD and self._hold is None and motion.speed <= limits.speed_stopped:
            self._hold = motion.position
        remaining = blind_time_left(inputs, limits)
        stop = self._stop.command(motion, hold=self._hold, path=self._path, floor=floor, remaining=remaining)
        # The attitude is only for a blind drone: it makes PX4 change controllers.
        return Command(stop.control, stop.attitude if math.isfinite(remaining) else None)

    def upcoming(self, now: float) -> NDArray[np.float64]:
        """Return the planned commands for the next control periods if no tick follows, shape [n, 4]."""
        period = 1.0 / self._config.rates.control
        count = min(UPCOMING_MAX, math.ceil(takeover_time(self._config) / period))
        age_max = self._config.limits.plan_age
        return np.clip(self._schedule.upcoming(now, period=period, count=count, age_max=age_max), *self._bounds)
