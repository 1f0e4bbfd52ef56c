"""A study of `aero-viz tune` as the page shows it: its progress, its candidates, the importance of each parameter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from aero_planner.config import DroneConfig


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class StudyPoint:
    """A candidate that flew in all worlds."""

    trial: int | None
    """Number of the trial; None for the incumbent."""
    config: DroneConfig
    estimates: Mapping[str, Estimate]
    """Figure on each axis: the Wilson interval of the share that arrives, and Student's t interval of the means over
    the flights that arrive. Without an arrival, there are no means."""
    on_front: bool
    """True if no other candidate arrives as often and is as good in every objective, and better in one."""


@dataclass(frozen=True)
class Importance:
    """Share of a parameter in the difference between the best quarter of the candidates and the rest; the sum is 1."""

    path: str
    share: float
    low: float
    """5 % quantile over resampled candidates, at most `share`."""
    high: float
    """95 % quantile, at least `share`."""


@dataclass(frozen=True)
class StudyView:
    """A study at one moment."""

    name: str
    finished: int
    """Number of candidates that have finished, besides the incumbent."""
    asked: int
    """Number of candidates that were asked for."""
    flights: int
    """Number of flights so far."""
    progress: float
    """Share of the candidates that is done, with those in flight in part, in [0, 1]."""
    axes: tuple[str, ...]
    """Axes of the front, with units."""
    points: tuple[StudyPoint, ...]
    importance: tuple[Importance, ...]
    """The most important parameter first; empty for fewer than eight complete candidates."""


class Study(Protocol):
    """A study that can be followed while it runs."""

    def read(self) -> StudyView:
        """Return the results so far; the same object if nothing has changed.

        Raises:
            UserError: it cannot be read any more.
        """
        ...
