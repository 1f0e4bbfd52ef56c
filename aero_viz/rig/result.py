"""The result of a flight on the rig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.rig.offboard import Mode, Setpoint
from aero_viz.rig.px4_log import Px4LogSummary, count_sign_changes


@dataclass(frozen=True)
class Event:
    """Something that happened during the flight."""

    time: float | None
    """Time since the engagement, when the node got control of the vehicle [s]; None before it."""
    text: str


@dataclass(frozen=True)
class Intervals:
    """Statistics of the times between two setpoints that arrive one after the other in OFFBOARD [s]."""

    count: int
    mean: float
    jitter: float
    """Standard deviation."""
    p99: float
    longest: float
    missed: int
    """Number of control periods without a setpoint. An interval of n and a half periods misses n of them."""


@dataclass(frozen=True)
class Handover:
    """State of the vehicle when the autopilot first left OFFBOARD."""

    time: float
    """Time since the engagement [s]."""
    speed: float
    """[m/s]"""
    tilt: float
    """Angle between the vehicle's axis and the vertical [rad]."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """True states of the vehicle after each step."""

    times: NDArray[np.float64]
    """Times since the engagement [s], shape [n]."""
    positions: NDArray[np.float64]
    """[m], shape [n, 3], world frame."""
    velocities: NDArray[np.float64]
    """[m/s], shape [n, 3], world frame."""
    offboard: NDArray[np.bool_]
    """True where the node controlled the vehicle, shape [n]."""

    def speeds(self) -> NDArray[np.float64]:
        """Return the speeds [m/s], shape [n]."""
        return np.linalg.norm(self.velocities, axis=1)


@dataclass(frozen=True)
class RigResult:
    """Result of one flight on the rig, in SI units. Times count from the engagement."""

    arrived: bool
    reason: str
    """"arrived", "collision", "out_of_bounds", "held" (the autopilot has the vehicle and it is at rest), "stopped" (the
    node holds it at rest, away from the goal), "timeout", or "not_ready" (the node never streamed setpoints)."""
    arrivals: int
    """Number of arrivals; more than one where the vehicle flies back and forth."""
    flight_time_s: float
    mean_speed: float
    max_speed: float
    min_clearance: float | None
    """Smallest distance from the vehicle's centre to a surface [m]; None in an empty world."""
    scene: str
    seed: int
    faults: list[str]
    events: list[Event]
    setpoints: int
    """Number of setpoints that the autopilot obeyed."""
    refused: int
    """Number of setpoints that the autopilot refused: wrong frame, not finite, or for another component."""
    violations: list[str]
    """Requests that only the pilot may make: arming, mode changes, stick inputs. The node must never send one."""
    intervals: Intervals | None
    """None with fewer than two setpoints, and when faults disturbed the flight."""
    sign_changes: tuple[float, float, float] | None
    """Changes of sign of the body rates that arrived in OFFBOARD, roll, pitch, yaw [1/s]; None where `intervals` is."""
    overruns: int
    """Number of simulation steps that began a whole step late, because the machine was too slow for real time."""
    log: list[str] = field(repr=False)
    """Lines that the node wrote."""
    trajectory: Trajectory = field(repr=False, compare=False)
    commands: list[Setpoint] = field(repr=False, compare=False)
    """Every setpoint that was understood, obeyed or not."""
    handover: Handover | None = None
    """None if the autopilot did not leave OFFBOARD."""
    px4_log: Px4LogSummary | None = None
    """Summary of PX4's log; None with the rig's own autopilot."""

    def with_log(self, log: Px4LogSummary | None) -> RigResult:
        """Return the result with the summary of PX4's log, and with its figures of the hand-back.

        The rig itself learns of it from a heartbeat, up to a second late, when PX4 has already slowed the vehicle down.
        """
        handover = self.handover
        ends = log is not None and math.isfinite(log.speed_at_end) and math.isfinite(log.tilt_at_end)
        if log is not None and handover is not None and ends:
            handover = Handover(log.offboard_time, log.speed_at_end, log.tilt_at_end)
        return dataclasses.replace(self, px4_log=log, handover=handover)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields in types that JSON has, without trajectory and commands."""
        content = vars(self).copy()
        del content["trajectory"], content["commands"]
        content["events"] = [dataclasses.asdict(event) for event in self.events]
        for name in ("handover", "intervals"):
            value = content[name]
            content[name] = dataclasses.asdict(value) if value else None
        content["px4_log"] = self.px4_log.to_dict() if self.px4_log else None
        return content


def sign_changes_of(setpoints: Sequence[Setpoint]) -> tuple[float, float, float] | None:
    """Return how often the signs of roll, pitch and yaw rate in OFFBOARD change [1/s], or None with fewer than two.

    Args:
        setpoints: setpoints in the order of their arrival.
    """
    obeyed = [setpoint for setpoint in setpoints if setpoint.mode is Mode.OFFBOARD and setpoint.rates is not None]
    if len(obeyed) < 2:
        return None
    rates = np.array([setpoint.rates for setpoint in obeyed])
    duration = obeyed[-1].time - obeyed[0].time
    roll, pitch, yaw = (count_sign_changes(rates[:, axis]) / duration for axis in range(3))
    return roll, pitch, yaw


def intervals_of(setpoints: Sequence[Setpoint], period: float) -> Intervals | None:
    """Return statistics of the setpoints in OFFBOARD, or None with fewer than two.

    Args:
        setpoints: setpoints in the order of their arrival.
        period: nominal time between two setpoints [s].
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
