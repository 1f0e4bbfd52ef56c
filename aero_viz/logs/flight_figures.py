"""Figures that sum up a flight, to compare it with another one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CLEARANCE_MAX = 5.0
"""Larger clearances count as this one [m]."""
LABELS = (
    "outcome", "time [s]", "length [m]", "mean speed [m/s]", "smallest clearance [m]", "median plan time [ms]",
    "ticks without safe candidate",
)  # fmt: skip
"""Labels of `FlightFigures.texts`."""


@dataclass(frozen=True)
class FlightFigures:
    """Figures of a flight, or of its part so far."""

    outcome: str
    time_s: float
    length_m: float
    mean_speed: float
    min_clearance: float
    plan_ms_median: float
    unsafe_ticks: int

    @classmethod
    def from_columns(cls, columns: Mapping[str, NDArray[np.float64]], outcome: str) -> FlightFigures:
        """Return the figures of a flight.

        Args:
            columns: "time" [s], "speed" [m/s], "clearance" [m], "plan_ms", "unsafe" (1 if no candidate was safe),
                "x", "y" and "z" [m], with a value for each tick from the start of the flight on.
            outcome: how it ended.
        """
        path = np.stack([columns[axis] for axis in "xyz"], axis=1)
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        duration = float(columns["time"][-1] - columns["time"][0])
        return cls(
            outcome=outcome,
            time_s=duration,
            length_m=length,
            mean_speed=length / duration if duration > 0.0 else float(columns["speed"][0]),
            min_clearance=float(columns["clearance"].min()),
            plan_ms_median=float(np.median(columns["plan_ms"])),
            unsafe_ticks=int(np.count_nonzero(columns["unsafe"])),
        )

    def texts(self) -> tuple[str, ...]:
        """Return the figures as texts, in the order of `LABELS`."""
        return (
            self.outcome.replace("_", " "),
            f"{self.time_s:.2f}",
            f"{self.length_m:.1f}",
            f"{self.mean_speed:.2f}",
            f"{self.min_clearance:.2f}",
            f"{self.plan_ms_median:.1f}",
            f"{self.unsafe_ticks}",
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain values for JSON."""
        return dataclasses.asdict(self)
