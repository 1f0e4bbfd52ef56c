"""What the node knows of the vehicle and tells it, whatever the protocol."""

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
    """Position, velocity and attitude, float64, finite, world frame, unit quaternion; its `time` is this `time`."""
    armed: bool
    """As the newest heartbeat says."""
    offboard: bool
    """Whether the autopilot takes commands from this computer, as the newest heartbeat says."""
    heartbeat_time: float
    """When the newest heartbeat arrived, host time [s]; -inf before the first."""
    resets: int = 0
    """Number of resets of the autopilot's estimator; positions before and after a reset are not comparable."""


class CommandSink(Protocol):
    """Where commands go."""

    def send(self, command: ArrayLike) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up; never blocks.

        Raises:
            ValueError: the command has another shape or is not finite; nothing was sent.
        """
        ...


class VehicleLink(CommandSink, Protocol):
    """A connection to an autopilot. `send` may be called from another thread than `poll`."""

    @property
    def state(self) -> VehicleSample | None:
        """The newest sample; None before the first. Heartbeats refresh its flags between two states."""
        ...

    @property
    def goal(self) -> NDArray[np.float64] | None:
        """The last goal received [m], shape [3], world frame; None before the first."""
        ...

    @property
    def dropped(self) -> Mapping[str, int]:
        """How many states and goals could not be used, by what was wrong with them."""
        ...

    def poll(self) -> None:
        """Take in what has arrived; never blocks, never raises for what the network brought."""
        ...

    def close(self) -> None:
        """Release the connection."""
        ...
