"""What the engine publishes: one immutable record per tick, and sentences for the user."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig
from aero_viz.session.source import Observation, Source

__all__ = ["Frame", "Notice"]


@dataclass(frozen=True, eq=False)
class Frame:
    """Record of one tick: what was seen, what was planned, and how. Never changed after it is published."""

    index: int
    """Number of the tick since the source's start; the row in its times for a recording."""
    time: float
    """Time in the source [s]."""
    observation: Observation
    plan: Plan
    config: PlannerConfig
    config_version: int
    """Counts the configurations of the session."""
    outcome: str | None
    """None while running; see `Source.outcome`."""
    explanation: str | None
    """In one sentence what the outcome leaves open; see `Source.explanation`."""
    timings_ms: dict[str, float]
    """Duration of "observe", "plan" and of the "advance" that led here [ms]."""
    rate: float
    """Ticks per second of wall time, over the last second."""
    dropped_ticks: int
    """Ticks that a recording skipped, or that came too late on a drone, since the source's start. A simulated flight
    skips none: it runs slower."""
    trail: NDArray[np.float32]
    """Positions so far [m], shape [n, 3], world frame; read-only."""
    epoch: int
    """Changes when time jumps or the source is exchanged."""
    source: Source
    """Where the observation comes from; its methods belong to the engine, so only read its attributes."""


@dataclass(frozen=True)
class Notice:
    """A sentence for the user."""

    level: Literal["info", "error"]
    text: str
