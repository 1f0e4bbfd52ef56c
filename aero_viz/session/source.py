"""Protocol between the engine and its input: a recording or a simulated flight."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from aero_planner import Goal, Plan, PlanStatus, Sweeps, VehicleState
from aero_planner.stages.memory.parameters import memory_duration
from aero_viz.reader_process import Reader, read_here

if TYPE_CHECKING:
    from aero_planner import Planner, PlannerConfig
    from aero_viz.scenes import World


@dataclass(frozen=True, eq=False)
class Observation:
    """Input of the planner at one tick."""

    time: float
    """Time since the start of the source [s]."""
    state: VehicleState
    """Estimated state, world frame."""
    goal: Goal
    """Goal, world frame."""
    sweeps: Sweeps
    """Last sweeps of the LiDAR, world frame [m]; rows with NaN or infinity are ignored."""
    cloud_age: float = 0.0
    """Time since the newest sweep [s]; the drone brakes when it exceeds partition.cloud_age_max."""
    empty_is_clear: bool = False
    """True if a sweep without points means that nothing is in range of the LiDAR, see `Planner.plan`."""
    ground_height: float | None = None
    """Height of the flat ground [m], world frame; None where there is none or it is unknown."""
    true_state: VehicleState | None = None
    """True state of a simulated vehicle; None for a recording."""
    sweep_times: NDArray[np.float64] | None = None
    """Time at the end of each sweep [s], oldest first; None where it is unknown."""
    world: World | None = None
    """World at this tick, where it can change; None where it is that of the source."""
    conditions: Mapping[str, Any] | None = None
    """Wind, noise and faults at this tick by path, such as "drone.gust_speed", where they can change."""
    recall: Callable[[float], tuple[Sweeps, NDArray[np.float64]]] | None = None
    """Returns the sweeps of the last seconds before this tick and their times, as long as the source stays there; None
    where all that are known are in `sweeps`."""

    def remembered(self, config: PlannerConfig) -> Observation:
        """Return this observation with the sweeps that the configuration remembers, see `memory_duration`."""
        if self.recall is None:
            return self
        sweeps, times = self.recall(memory_duration(config))
        return dataclasses.replace(self, sweeps=sweeps, sweep_times=times, recall=None)

    @property
    def points(self) -> NDArray[np.float32]:
        """Joined cloud [m], shape [P, 3], world frame; the same array as long as the sweeps are the same."""
        return self.sweeps.points

    def plan_with(self, planner: Planner, *, samples: bool = False) -> Plan:
        """Return the plan of a planner for this observation; arguments and errors as for `Planner.plan`."""
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


@dataclass(frozen=True, eq=False)
class RecordedPlan:
    """Plan that was flown, from a flight log. M instances with N time steps."""

    time: float
    """Source time [s]."""
    path: NDArray[np.float32]
    """Positions of the chosen rollout [m], shape [N+1, 3], world frame."""
    best: int
    """Chosen instance."""
    kinds: tuple[str, ...]
    """Kind of each instance, length M."""
    status: PlanStatus
    stage2_cost: NDArray[np.float32]
    """S2 of each instance, shape [M]."""
    clearance: NDArray[np.float32]
    """Smallest distance of each instance to the cloud, at most d_max [m], shape [M]."""


@dataclass(frozen=True, eq=False)
class SourceInfo:
    """Facts about a source that hold as long as it runs. Two sources never share one object."""

    name: str
    """Short name for the user."""
    closed_loop: bool
    """True if the plan is flown, False if a recorded motion is replayed."""
    period: float
    """Nominal time between two ticks [s]."""
    start: NDArray[np.float64]
    """First position of the drone [m], shape [3]."""
    times: NDArray[np.float64] | None = None
    """Tick times of a recording [s], shape [n]; None for a flight."""
    world: World | None = None
    """Obstacles of a synthetic world."""
    recorded_path: NDArray[np.float64] | None = None
    """Recorded positions [m], shape [n, 3]."""
    recorded_plan: Callable[[float], RecordedPlan | None] | None = None
    """Returns the plan that was flown at a time [s]; None if no plans are recorded."""
    notices: tuple[str, ...] = ()
    """Sentences for the user, such as "the plan is computed now, and is not flown"."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Conditions that reproduce a flight, besides its world, goals and configurations; values that JSON can hold."""


class Source(Protocol):
    """Sweeps and states over time. All methods are called from one thread."""

    @property
    def info(self) -> SourceInfo:
        """Facts that hold as long as the source runs; always the same object."""
        ...

    @property
    def outcome(self) -> str | None:
        """None while running, then "arrived", "collision", "stall", "out_of_bounds", "timeout" or "end"."""
        ...

    @property
    def explanation(self) -> str | None:
        """One sentence on why a flight ended, or on which sweeps of a recording could not be read so far.

        None if the outcome says it all.
        """
        ...

    def observe(self) -> Observation:
        """Return the observation at the current tick. Has no side effects."""
        ...

    def advance(self, plan: Plan) -> None:
        """Advance by one tick; a closed loop flies `plan`."""
        ...

    def checkpoint(self) -> object:
        """Return everything that `restore` needs to continue from here exactly. Small: one is kept for every tick."""
        ...

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source."""
        ...

    def seek(self, time: float) -> None:
        """Go to the tick at or before `time` [s]; recordings only."""
        ...

    def set_goal(self, position: NDArray[np.float64]) -> None:
        """Move the goal to `position` [m], shape [3], world frame.

        Raises:
            UserError: the position cannot be flown to; the goal stays.
        """
        ...

    def close(self) -> None:
        """Release files and device memory."""
        ...


@dataclass(frozen=True)
class Conditions:
    """Conditions of a simulated flight that a user chooses besides world and seed."""

    count: int | None = None
    """Number of obstacles of a scene; None is its own."""
    lidar: str | None = None
    """Name of the LiDAR model; None is that of the program's flags."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of noise and drone by path, such as "noise.position"; the others are those of the program's flags."""


class Opener(Protocol):
    """Opens a source by name or path."""

    def __call__(
        self, spec: str, /, *, seed: int, read: Reader = read_here, conditions: Conditions | None = None
    ) -> Source:
        """Open a recording, a world or a scene.

        Args:
            spec: name or path.
            seed: seed of the scene, the LiDAR and all noise.
            read: calls the functions that read files, here or in another process.
            conditions: conditions of a flight; None are those of the program's flags.

        Raises:
            UserError: it does not exist or cannot be used.
        """
        ...
