"""What is known of a flight on the rig when it is over."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.rig.autopilot import Mode, Setpoint

__all__ = ["Event", "Intervals", "RigResult", "Trajectory", "intervals_of"]


@dataclass(frozen=True)
class Event:
    """Something that happened."""

    time: float | None
    """Since the node was given the vehicle [s]; None before."""
    what: str


@dataclass(frozen=True)
class Intervals:
    """Times between one setpoint's arrival and the next one's, in OFFBOARD [s]."""

    count: int
    mean: float
    jitter: float
    """Standard deviation."""
    p99: float
    longest: float
    missed: int
    """Control periods in which no setpoint came: an interval of n and a half periods misses n of them."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """True states after each step."""

    times: NDArray[np.float64]
    """Since the node was given the vehicle [s], shape [n]."""
    positions: NDArray[np.float64]
    """[m], shape [n, 3], world frame."""
    velocities: NDArray[np.float64]
    """[m/s], shape [n, 3], world frame."""
    offboard: NDArray[np.bool_]
    """Whether the node had the vehicle, shape [n]."""

    def speeds(self) -> NDArray[np.float64]:
        """Return the speeds [m/s], shape [n]."""
        return np.linalg.norm(self.velocities, axis=1)


@dataclass(frozen=True)
class RigResult:
    """Outcome of one flight on the rig, SI units; times count from when the node was given the vehicle."""

    arrived: bool
    reason: str
    """"arrived", "collision", "out_of_bounds", "held" (the autopilot has the vehicle and it is at rest), "stopped" (the
    node holds it at rest, away from the goal), "timeout", or "not_ready": the node never streamed setpoints."""
    arrivals: int
    """More than one where the vehicle flies to and fro."""
    flight_time_s: float
    mean_speed: float
    max_speed: float
    min_clearance: float | None
    """Smallest distance from the centre to a surface [m]; None in an empty world."""
    scene: str
    seed: int
    faults: list[str]
    events: list[Event]
    setpoints: int
    """That were obeyed."""
    refused: int
    trespasses: list[str]
    """What the node asked the autopilot for and must not: arming, switching modes."""
    intervals: Intervals | None
    """None with fewer than two setpoints, or when faults disturbed the flight."""
    overruns: int
    """Steps of the simulation that began a whole step late: the machine was too slow for real time."""
    log: list[str] = field(repr=False)
    """What the node wrote."""
    trajectory: Trajectory = field(repr=False, compare=False)
    commands: list[Setpoint] = field(repr=False, compare=False)
    """Every setpoint."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON can hold them, without trajectory and commands."""
        kept = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del kept["trajectory"], kept["commands"]
        kept["events"] = [dataclasses.asdict(event) for event in self.events]
        kept["intervals"] = dataclasses.asdict(self.intervals) if self.intervals else None
        return kept


def intervals_of(setpoints: Sequence[Setpoint], period: float) -> Intervals | None:
    """Return the statistics of the setpoints in OFFBOARD; None with fewer than two.

    Args:
        setpoints: in order of arrival.
        period: nominal time between two [s].
    """
    times = [setpoint.time for setpoint in setpoints if setpoint.mode is Mode.OFFBOARD]
    if len(times) < 2:
        return None
    gaps = np.diff(times)
    missed = np.maximum(np.floor(gaps / period - 0.5), 0.0)
    return Intervals(
        count=len(gaps),
        mean=float(gaps.mean()),
        jitter=float(gaps.std()),
        p99=float(np.percentile(gaps, 99.0)),
        longest=float(gaps.max()),
        missed=int(missed.sum()),
    )
