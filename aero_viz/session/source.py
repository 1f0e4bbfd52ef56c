"""What a source of sweeps and states gives to the engine: a recording or a flight behind one protocol."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from aero_planner import Goal, Plan, VehicleState

if TYPE_CHECKING:
    from aero_viz.scenes import World

__all__ = ["Observation", "Opener", "Scenery", "Source"]


@dataclass(frozen=True, eq=False)
class Observation:
    """What the planner sees at one tick."""

    time: float
    """Time since the start of the source [s]."""
    state: VehicleState
    """Estimated state, world frame."""
    goal: Goal
    """Where to fly, world frame."""
    points: NDArray[np.float32]
    """Accumulated cloud [m], shape [P, 3], world frame; rows that are not finite are no points."""
    sweep_count: int = 0
    """Number of sweeps accumulated in `points`."""
    cloud_age: float = 0.0
    """Time since the newest sweep [s]; the drone brakes when it exceeds partition.cloud_age_max."""
    ground_height: float | None = None
    """Height of the flat ground [m], world frame; None where there is none or it is unknown."""
    true_state: VehicleState | None = None
    """True state of a simulated vehicle, None on a recording."""

    @property
    def actual_state(self) -> VehicleState:
        """Where the drone is, as well as can be known: the true state, else the estimated one."""
        return self.true_state or self.state


@dataclass(frozen=True, eq=False)
class Scenery:
    """What stands still and can be drawn once."""

    start: NDArray[np.float64]
    """First position of the drone [m], shape [3]."""
    world: World | None = None
    """Obstacles of a synthetic world."""
    recorded_path: NDArray[np.float64] | None = None
    """Recorded positions [m], shape [n, 3]."""
    notices: tuple[str, ...] = field(default=())
    """Sentences the user should see, such as "open loop: the plan is displayed but not flown"."""

    @property
    def ground_height(self) -> float | None:
        """Height of the flat ground [m]; None where there is none, or none is known of."""
        return None if self.world is None else self.world.ground_height


class Source(Protocol):
    """Sweeps and states over time. Called from one thread."""

    @property
    def name(self) -> str:
        """Short name for the user."""
        ...

    @property
    def closed_loop(self) -> bool:
        """True when the plan is flown, False when a recording is replayed."""
        ...

    @property
    def period(self) -> float:
        """Nominal time between two ticks [s]."""
        ...

    @property
    def times(self) -> NDArray[np.float64] | None:
        """Tick times of a recording [s], shape [n]; None for a flight, which ends when it ends."""
        ...

    @property
    def scenery(self) -> Scenery:
        """What stands still and can be drawn once."""
        ...

    @property
    def outcome(self) -> str | None:
        """None while running, then "arrived", "collision", "stall", "out_of_bounds", "timeout" or "end"."""
        ...

    @property
    def explanation(self) -> str | None:
        """In one sentence what ended a flight, or what of a recording could not be read so far; None where there is
        nothing to tell beyond the outcome."""
        ...

    def observe(self) -> Observation:
        """Return the current tick's observation; without side effects."""
        ...

    def advance(self, plan: Plan) -> None:
        """Go one tick on, flying `plan` when the loop is closed."""
        ...

    def checkpoint(self) -> object:
        """Return all that `restore` needs to continue from here exactly; small, as one is kept for every tick."""
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
            UserError: it can't be flown to, and the goal stays.
        """
        ...

    def close(self) -> None:
        """Release files and device memory."""
        ...


class Opener(Protocol):
    """Makes a source from what a user names."""

    def __call__(self, spec: str, /, *, seed: int) -> Source:
        """Open a recording, a world or a scene, with the `seed` of the scene, the LiDAR and all noise.

        Raises:
            UserError: what is named does not exist or cannot be used.
        """
        ...
