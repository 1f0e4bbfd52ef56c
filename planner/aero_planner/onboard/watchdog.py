"""What brakes the drone when the control loop does not."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.link import VehicleLink
from aero_planner.onboard.motion import Motion, StopController, propagate
from aero_planner.onboard.settings import LimitSettings

__all__ = ["Watchdog"]

_log = logging.getLogger(__name__)


class _Beat(NamedTuple):
    time: float
    motion: Motion | None
    command: NDArray[np.float64] | None


class Watchdog:
    """Streams the braking command in the place of a control loop that stands still.

    The loop says at the end of each tick where the drone is and whether it obeys. When no tick has ended for
    `limits.deadline`, `check`, called by another thread, levels and brakes from there by dead reckoning, for
    `limits.blind_time`; then it falls silent and the autopilot's own failsafe takes over.

    Args:
        link: to the autopilot.
        stop: how to brake.
        vehicle: the model to reckon with.
        limits: see `LimitSettings`.
        period: between two calls of `check` [s].
    """

    def __init__(
        self, link: VehicleLink, stop: StopController, vehicle: VehicleConfig, limits: LimitSettings, period: float
    ) -> None:
        self._link = link
        self._stop = stop
        self._vehicle = vehicle
        self._limits = limits
        self._period = period
        # Replaced whole by the loop and only read here.
        self._beat = _Beat(math.nan, None, None)
        self._motion: Motion | None = None
        self._acting_on: _Beat | None = None
        self.interventions = 0
        """Times that the loop had to be replaced."""

    def beat(self, now: float, motion: Motion | None, command: NDArray[np.float64] | None) -> None:
        """End a tick of the control loop at `now` [s].

        Args:
            now: [s].
            motion: of the drone, where known.
            command: what it obeys, shape [4]; None where it does not obey us.
        """
        self._beat = _Beat(now, motion, command)

    def overrun(self, now: float) -> bool:
        """Return whether the tick that begins at `now` [s] comes too late."""
        return now - self._beat.time > self._limits.deadline

    def check(self, now: float) -> bool:
        """Brake if the loop stands still; return whether a command was sent."""
        beat = self._beat
        silent = now - beat.time
        if beat.command is None or beat.motion is None or not silent > self._limits.deadline:
            return False
        if silent > self._limits.deadline + self._limits.blind_time:
            return False
        if beat is not self._acting_on or self._motion is None:
            self._acting_on = beat
            self._motion = propagate(beat.motion, beat.command, max(now, beat.motion.time), self._vehicle)
            self.interventions += 1
            _log.error("the control loop has stood still for %.0f ms: the watchdog brakes", 1e3 * silent)
        command = self._stop.command(self._motion)
        self._link.send(command)
        self._motion = propagate(self._motion, command, now + self._period, self._vehicle)
        return True
