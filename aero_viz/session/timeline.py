"""Checkpoints of all ticks so far, each of which can be repeated exactly."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import DroneConfig

_CAPACITY = 30_000
"""Number of checkpoints kept by default: ten minutes of flight at 50 Hz."""


@dataclass(frozen=True, eq=False, slots=True)
class Checkpoint:
    """Everything that is needed to repeat one tick bit for bit."""

    time: float
    """Source time [s]."""
    source: object
    """Checkpoint of the source, before the tick's plan is flown."""
    planner: Any
    """State of the planner before the tick's plan."""


class Timeline:
    """Checkpoints of the ticks so far, with a cursor at the current one.

    Appending after an earlier tick discards the later ones.

    Args:
        capacity: number of ticks that are kept.
    """

    def __init__(self, capacity: int = _CAPACITY) -> None:
        self._capacity = capacity
        self._checkpoints: list[Checkpoint] = []
        self._configs: list[DroneConfig | None] = []
        """Configuration with which each tick was planned last."""
        self._discarded = 0
        self._cursor = -1
        self._positions = np.empty((1024, 3), dtype=np.float32)
        self._shared_rows = 0

    def __len__(self) -> int:
        return len(self._checkpoints)

    @property
    def index(self) -> int:
        """Number of the current tick since the start."""
        return self._discarded + self._cursor

    @property
    def earlier(self) -> int:
        """Number of earlier ticks that can be returned to."""
        return self._cursor

    @property
    def current(self) -> Checkpoint:
        """Checkpoint of the current tick."""
        return self._checkpoints[self._cursor]

    @property
    def time_range(self) -> tuple[float, float]:
        """First and last time that can be returned to [s]."""
        return (self._checkpoints[0].time, self._checkpoints[-1].time) if self._checkpoints else (0.0, 0.0)

    def append(self, checkpoint: Checkpoint, position: ArrayLike) -> None:
        """Add a tick after the current one; the drone is at `position` [m], shape [3]."""
        del self._checkpoints[self._cursor + 1 :], self._configs[self._cursor + 1 :]
        self._checkpoints.append(checkpoint)
        self._configs.append(None)
        if len(self._checkpoints) > self._capacity:
            del self._checkpoints[0], self._configs[0]
            self._discarded += 1
        self._cursor = len(self._checkpoints) - 1
        row = self.index
        if row >= len(self._positions):
            self._positions = np.concatenate((self._positions, np.empty_like(self._positions)))
        elif row < self._shared_rows:
            # Trails returned earlier share this row and must not change.
            self._positions = self._positions.copy()
        self._positions[row] = position
        self._shared_rows = row + 1

    def amend(self, source: object) -> None:
        """Replace the source's part of the current checkpoint."""
        self._checkpoints[self._cursor] = dataclasses.replace(self.current, source=source)

    def planned_with(self, config: DroneConfig) -> None:
        """Record the configuration with which the current tick was planned."""
        self._configs[self._cursor] = config

    def flown(self) -> list[tuple[Checkpoint, DroneConfig]]:
        """Return every tick that can be returned to, with the configuration of its last plan."""
        ticks = zip(self._checkpoints, self._configs, strict=True)
        return [(checkpoint, config) for checkpoint, config in ticks if config is not None]

    def trail(self) -> NDArray[np.float32]:
        """Return the positions up to the current tick [m], shape [n, 3]. Read-only, and never changed later."""
        trail = self._positions[: self.index + 1]
        trail.flags.writeable = False
        return trail

    def go_to_time(self, time: float) -> Checkpoint:
        """Move the cursor to the last tick at or before `time` [s], or to the first one."""
        times = [checkpoint.time for checkpoint in self._checkpoints]
        return self.go_by(int(np.searchsorted(times, time + 1e-9, side="right")) - 1 - self._cursor)

    def go_by(self, count: int) -> Checkpoint:
        """Move the cursor by `count` ticks, at most to the first or last one."""
        self._cursor = min(max(self._cursor + count, 0), len(self._checkpoints) - 1)
        return self.current
