"""What a planner is given at one tick."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Goal, Sweeps, VehicleState
from aero_planner.config import DroneConfig
from aero_planner.mission_progress import MissionProgress

if TYPE_CHECKING:
    from aero_planner import Plan, Planner
    from aero_viz.scenes import World


@functools.lru_cache(maxsize=8)
def _with_speed_limit(config: DroneConfig, speed: float) -> DroneConfig:
    return config.replace({"vehicle.speed_limit": speed})


@dataclass(frozen=True, eq=False)
class Observation:
    """Input of a planner at one tick."""

    time: float
    """Time since the start of the source [s]."""
    state: VehicleState
    """Estimated state, world frame."""
    goal: Goal
    """Goal, world frame."""
    sweeps: Sweeps
    """Last sweeps of the LiDAR, world frame [m]; rows with NaN or infinity are ignored."""
    cloud_age: float = 0.0
    """Time since the newest sweep [s]; a planner brakes when it is too old."""
    empty_is_clear: bool = False
    """True if a sweep without points means that nothing is in range of the LiDAR, see `aero_planner.Planner.plan`."""
    ground_height: float | None = None
    """Height of the flat ground [m], world frame; None where there is none or it is unknown."""
    true_state: VehicleState | None = None
    """True state of a simulated vehicle; None for a recording."""
    sweep_times: NDArray[np.float64] | None = None
    """Time at the end of each sweep [s], oldest first; None where it is unknown."""
    mission: MissionProgress | None = None
    """Mission of which `goal` is a part; None where it is not known."""
    world: World | None = None
    """World at this tick, where it can change; None where it is that of the source."""
    conditions: Mapping[str, Any] | None = None
    """Wind, noise and faults at this tick by path, such as "drone.gust_speed", where they can change."""
    recall: Callable[[float], tuple[Sweeps, NDArray[np.float64]]] | None = None
    """Returns the sweeps of the last seconds before this tick and their times, as long as the source stays there; None
    where all that are known are in `sweeps`."""

    def remembered(self, config: DroneConfig) -> Observation:
        """Return this observation with the sweeps that the configuration remembers, see `DroneConfig.sweep_memory`."""
        if self.recall is None:
            return self
        sweeps, times = self.recall(config.sweep_memory)
        return dataclasses.replace(self, sweeps=sweeps, sweep_times=times, recall=None)

    def leg_config(self, config: DroneConfig) -> DroneConfig:
        """Return the configuration with the speed limit of the mission's present leg, the same object at every tick."""
        speed = None if self.mission is None else self.mission.waypoint.speed
        return config if speed in (None, config.vehicle.speed_limit) else _with_speed_limit(config, speed)

    @property
    def points(self) -> NDArray[np.float32]:
        """Joined cloud [m], shape [P, 3], world frame; the same array as long as the sweeps are the same."""
        return self.sweeps.points

    def plan_with(self, planner: Planner, *, samples: bool = False) -> Plan:
        """Return the plan of `aero_planner.Planner` for this observation; arguments and errors as for its `plan`."""
        return planner.plan(
            self.state,
            self.goal,
            self.sweeps,
            cloud_age=self.cloud_age,
            empty_is_clear=self.empty_is_clear,
            ground_height=self.ground_height,
            samples=samples,
        )

    @property
    def actual_state(self) -> VehicleState:
        """The true state if it is known, otherwise the estimated one."""
        return self.true_state or self.state
