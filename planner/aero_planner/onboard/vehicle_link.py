"""The interface between the node and an autopilot, independent of the protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.plan import VehicleState

__all__ = ["CommandSink", "VehicleLink", "VehicleSample"]


@dataclass(frozen=True, eq=False)
class VehicleSample:
    """The vehicle at one time."""

    time: float
    """When the state was measured, host time (`time.monotonic`) [s]; never later than its arrival."""
    state: VehicleState
    """Position, velocity and attitude, float64, finite, world frame, unit quaternion. Its `time` equals `time`."""
    armed: bool
    """True if the newest heartbeat reports that the vehicle is armed."""
    offboard: bool
    """True if the newest heartbeat reports that the autopilot takes commands from this computer."""
    heartbeat_time: float
    """When the newest heartbeat arrived, host time [s]; -inf before the first."""
    resets: int = 0
    """Number of resets of the autopilot's estimator; positions before and after a reset are not comparable."""


class CommandSink(Protocol):
    """Receiver of commands."""

    def send(self, command: ArrayLike) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up. Never blocks.

        Raises:
            ValueError: The command has another shape or is not finite; nothing was sent.
        """
        ...


class VehicleLink(CommandSink, Protocol):
    """Connection to an autopilot. `send` and `poll` may be called from different threads."""

    @property
    def state(self) -> VehicleSample | None:
        """The newest sample; None before the first. Heartbeats update its flags between two states."""
        ...

    @property
    def goal(self) -> NDArray[np.float64] | None:
        """The last goal received [m], shape [3], world frame; None before the first."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """Number of states and goals that could not be used, by reason."""
        ...

    def poll(self) -> None:
        """Read what has arrived. Never blocks; never raises for bad data."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...
