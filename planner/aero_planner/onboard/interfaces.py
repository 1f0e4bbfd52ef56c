"""The interfaces of the node: to a LiDAR, to an autopilot, independent of their protocols, and to observers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import PlannerConfig
from aero_planner.mission_progress import MissionEvent, MissionProgress
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.plan import Plan, VehicleState
from aero_planner.sweeps import Sweeps


@dataclass(frozen=True, eq=False)
class PointPacket:
    """Points in the order in which they were measured."""

    points: NDArray[np.float32]
    """[m], shape [n, 3], sensor frame (x forward, y left, z up); finite."""
    times: NDArray[np.float64]
    """Time of measurement of each point, host time (`time.monotonic`) [s], shape [n]; never later than its arrival."""


@dataclass
class PointCounters:
    """Counts of packets and points since the start."""

    packets: int = 0
    """Packets that were used."""
    lost: int = 0
    """Packets missing in the sequence. A packet that arrives late is subtracted again."""
    bad: int = 0
    """Packets that were refused: wrong length, version, type or checksum, or an inconsistent time stamp."""
    duplicates: int = 0
    """Packets that arrived a second time and were refused."""
    points: int = 0
    """Points that were passed on."""
    filtered: int = 0
    """Points that were removed: rays without return, and points that the sensor marks as noise."""


class PointSource(Protocol):
    """A LiDAR. All methods are called from one thread."""

    @property
    def counters(self) -> PointCounters:
        """Counts of packets and points."""
        ...

    def poll(self) -> list[PointPacket]:
        """Return the points that have arrived since the last call, oldest first.

        Never blocks; never raises for bad data.
        """
        ...

    def close(self) -> None:
        """Release the connection."""
        ...


@dataclass(frozen=True, eq=False)
class VehicleSample:
    """The vehicle at one time."""

    time: float
    """Time at which the state was measured, host time (`time.monotonic`) [s]; never later than its arrival."""
    state: VehicleState
    """Position, velocity and attitude, float64, finite, world frame, unit quaternion. Its `time` equals `time`."""
    armed: bool
    """True if the newest heartbeat reports that the vehicle is armed."""
    offboard: bool
    """True if the newest heartbeat reports that the autopilot takes commands from this computer."""
    heartbeat_time: float
    """Time at which the newest heartbeat arrived, host time [s]; -inf before the first."""
    resets: int = 0
    """Number of resets of the autopilot's estimator; positions before and after a reset are not comparable."""
    in_air: bool | None = None
    """True if the autopilot reports that the vehicle is in the air; False if it is on the ground, taking off or
    landing; None if there is no recent report."""
    position_std: float = math.nan
    """Standard deviation of the position along its most uncertain axis, as the autopilot estimates it [m]; NaN if the
    autopilot does not report it."""
    velocity_std: float = math.nan
    """The same for the velocity [m/s]."""
    fix_time: float = math.nan
    """Time at which the autopilot's GNSS receiver last reported a fix, host time [s]; NaN if it never did."""
    ground_height: float = math.nan
    """Height of the ground below the vehicle as its distance sensor measures it, world frame [m]; NaN without a recent
    measurement."""
    supported: bool = True
    """False if the vehicle says that it is of a kind that thrust and body rates from here do not steer as assumed."""
    transmitter: bool | None = None
    """True if the autopilot hears the pilot's transmitter, False if it does no longer; None if it never did."""
    battery_low: bool = False
    """True if the autopilot has warned of a low battery."""
    round_trip: float = math.nan
    """Time from a request to the autopilot to its answer, median of the last moments [s]; NaN if none is measured."""


class CommandSink(Protocol):
    """Receiver of commands."""

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up. Never blocks.

        With an `attitude`, body to world, w x y z, shape [4], an autopilot that can control the attitude does so.

        Raises:
            ValueError: The command has another shape or is not finite; nothing was sent.
        """
        ...


class VehicleLink(CommandSink, Protocol):
    """Connection to an autopilot. `send` and `poll` may be called from different threads."""

    thrust_gain: float
    """True thrust divided by that of the vehicle's thrust model; `send` divides by it."""

    @property
    def state(self) -> VehicleSample | None:
        """The newest sample; None before the first. Heartbeats update its flags between two states."""
        ...

    @property
    def goal(self) -> NDArray[np.float64] | None:
        """The last goal received [m], shape [3], world frame; None before the first."""
        ...

    @property
    def offer(self) -> MissionOffer | None:
        """The last mission received; None before the first."""
        ...

    def report_mission(self, progress: MissionProgress | None) -> None:
        """Tell the ground about the progress in the mission; None if there is no mission."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of states and goals that could not be used, by reason."""
        ...

    @property
    def ignored(self) -> Mapping[str, int]:
        """Number of messages that were ignored because of their sender, by kind and sender."""
        ...

    def poll(self) -> None:
        """Read the messages that have arrived. Never blocks; never raises for bad data."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...


@dataclass(frozen=True, eq=False)
class PlanResult:
    """A plan and its inputs."""

    number: int
    """Counts the plans."""
    time: float
    """Time at which the planner was called, host time [s]."""
    state: VehicleState
    """State from which the plan starts: the measured state, predicted for when the plan was expected to be ready."""
    measured: VehicleState
    """Newest measured state."""
    goal: NDArray[np.float64]
    """[m], shape [3], world frame."""
    cloud: Sweeps
    """Points that the planner saw, world frame [m]."""
    cloud_age: float
    """Age of the newest point [s]."""
    plan: Plan
    plan_ms: float
    """Duration of the planner's call [ms]."""

    @property
    def points(self) -> NDArray[np.float32]:
        """The joined cloud [m], shape [P, 3], world frame."""
        return self.cloud.points


@dataclass(frozen=True, eq=False)
class PlanRecord(PlanResult):
    """A plan, its inputs, and the state of the node."""

    safety: State
    missing: tuple[Cause, ...] = ()
    """Reasons for which the drone does not fly the plan, see `SafetyMachine.missing`."""
    late_ticks: int = 0
    """Number of deadlines that the control loop has missed since the start."""
    sweeps: int = 10
    """Number of sweeps in the cloud, with the thinned ones."""
    mission: MissionProgress | None = None
    """Progress in the mission; None without one."""


@dataclass(frozen=True, eq=False)
class ConfigChange:
    """A change of the planner's configuration while the node runs."""

    time: float
    """Host time [s]."""
    version: int
    """Counts the changes."""
    config: PlannerConfig
    """Configuration from the next plan on."""


Observation: TypeAlias = PlanRecord | StateChange | ConfigChange | MissionEvent | VehicleSample | PointPacket


class Observer:
    """Base class of observers, such as the flight log. Every method must return at once and must not raise."""

    def observe(self, item: Observation) -> None:
        """Receive an item: plans and changes of the configuration from the planning thread, the rest from the control
        thread.
        """

    def close(self) -> None:
        """Release resources; the node has ended."""
