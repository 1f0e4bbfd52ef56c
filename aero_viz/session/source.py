"""Protocol between the engine and its input: a recording or a simulated flight."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlanStatus
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan
from aero_viz.reader_process import Reader, read_here

if TYPE_CHECKING:
    from aero_viz.scenes import World


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
    kept: int | None = None
    """Number of ticks of a live stream that can be returned to; None for a source that is not live."""
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
