"""Records that a session publishes: one immutable frame per tick, and notices for the user."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import DroneConfig
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan
from aero_viz.session.source import RecordedPlan, SourceInfo
from aero_viz.session.timeline import Checkpoint

if TYPE_CHECKING:
    from aero_viz.scenes import World


@dataclass(frozen=True, eq=False)
class Frame:
    """Record of one tick: the planner's input, its plan, and how the plan was computed. Immutable once published."""

    index: int
    """Number of the tick since the source's start; for a recording, the row in `source.times`."""
    time: float
    """Source time [s]."""
    observation: Observation
    """Input of the planner."""
    plan: Plan
    """Output of the planner."""
    config: DroneConfig
    """Configuration of the planner, with the speed limit of the leg of a mission."""
    config_version: int
    """Number of configuration changes in the session so far."""
    outcome: str | None
    """None while the source is running; see `Source.outcome`."""
    explanation: str | None
    """One sentence that explains the outcome; see `Source.explanation`."""
    timings_ms: Mapping[str, float]
    """Duration of "observe", of "plan" and of the "advance" that led to this tick [ms]."""
    rate: float
    """Ticks per wall second, over the last second [Hz]."""
    dropped_ticks: int
    """Ticks since the source's start that a recording skipped or a drone missed. A simulated flight drops none: it
    runs slower instead."""
    trail: NDArray[np.float32]
    """Positions so far [m], shape [n, 3], world frame; read-only."""
    epoch: int
    """Changes when time jumps or another source starts."""
    source: SourceInfo
    """The source of the observation; another object means another source."""
    checkpoint: Checkpoint | None = None
    """Checkpoint with which this tick is planned again, also by another configuration; None where it cannot be."""
    seed: int = 0
    """Seed of the planner's noise."""
    device: str = "cpu"
    """Warp device of the planner."""
    base_config: DroneConfig | None = None
    """Configuration of the session, which differs from `config` on legs with a speed limit of their own; None where it
    is not known."""
    is_safe: NDArray[np.bool_] | None = None
    """True for each safe candidate, shape [M]; None where only the plan is known, see `safety.known_safe`."""

    @property
    def drone_position(self) -> NDArray[np.float64]:
        """True position of the drone, or the recorded one [m], shape [3], world frame."""
        return np.asarray(self.observation.actual_state.position, dtype=np.float64)

    @property
    def moving_world(self) -> World | None:
        """Synthetic world that is flown in at this tick, with the motion of its obstacles."""
        return self.observation.world or self.source.world

    @property
    def recorded_plan(self) -> RecordedPlan | None:
        """Plan that was flown at this tick, from a flight log; `plan` was then computed again, and is not flown."""
        return None if self.source.recorded_plan is None else self.source.recorded_plan(self.time)

    @cached_property
    def world(self) -> World | None:
        """Obstacles of a synthetic world, where they are at this tick."""
        return None if self.moving_world is None else self.moving_world.at(self.time)


@dataclass(frozen=True)
class Notice:
    """A message for the user."""

    level: Literal["info", "failure", "error"]
    """"failure": a flight did not arrive; "error": a request failed."""
    text: str
    """One or more sentences."""


def end_sentence(name: str, outcome: str, explanation: str | None) -> str:
    """Return how a source has ended, by its name, its outcome and its explanation."""
    ending = {
        "arrived": "arrived at the goal.",
        "collision": "collided.",  # with an obstacle or the ground
        "stall": "stalled: it no longer moves on.",
        "out_of_bounds": "left the world.",
        "timeout": "ran out of time.",
        "end": "end of the recording.",
        "planner_failed": "ended.",
    }.get(outcome, outcome)
    return f"{name}: {ending} {explanation or ''}".rstrip()
