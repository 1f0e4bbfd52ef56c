"""What brakes the drone when the control loop does not."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.link import CommandSink
from aero_planner.onboard.motion import Motion, StopController, propagate

__all__ = ["Beat", "Watchdog"]

_log = logging.getLogger(__name__)


class Beat(NamedTuple):
    """What is known at the end of a tick of the control loop, or of one in its place."""

    time: float
    """[s]"""
    motion: Motion | None
    """Of the drone, where known."""
    command: NDArray[np.float64] | None
    """What it obeys from then on, shape [4]; None where it does not obey us."""


class Watchdog:
    """Streams the braking command in the place of a control loop that stands still.

    The loop says at the end of each tick where the drone is and whether it obeys. When no tick has ended for
    `deadline`, `check`, called by somebody else than the loop, brakes and levels from there by dead reckoning, for
    `blind_time`. Then it says to hover without turning and falls silent: the autopilot's own failsafe takes over.

    Args:
        link: to the autopilot.
        stop: how to brake.
        vehicle: the model to reckon with.
        deadline, blind_time: see `aero_planner.onboard.settings.LimitSettings` [s].
        name: what the log calls it.
    """

    def __init__(
        self,
        link: CommandSink,
        stop: StopController,
        vehicle: VehicleConfig,
        *,
        deadline: float,
        blind_time: float,
        name: str = "watchdog",
    ) -> None:
        self._link = link
        self._stop = stop
        self._vehicle = vehicle
        self._patience = deadline
        self._blind_time = blind_time
        self._name = name
        # Replaced whole by the loop and only read here.
        self._beat = Beat(math.nan, None, None)
        # What was done in the loop's place since, and since which beat.
        self._own = self._beat
        self._acting_on: Beat | None = None
        self.interventions = 0
        """Times that the loop had to be replaced."""

    def beat(self, now: float, motion: Motion | None, command: NDArray[np.float64] | None) -> None:
        """End a tick of the control loop at `now` [s]; the arguments are those of a `Beat`."""
        self._beat = Beat(now, motion, None if motion is None else command)

    def silence(self, now: float) -> float:
        """Return for how long the loop has been silent at `now` [s]; 0 before its first beat."""
        return 0.0 if math.isnan(self._beat.time) else now - self._beat.time

    def give_up(self, now: float) -> None:
        """Say, at `now` [s], that the loop will not come back: `check` need not wait any longer."""
        self._patience = min(self._patience, self.silence(now))

    @property
    def acting(self) -> bool:
        """Whether it has replaced the loop since the newest beat."""
        return self._acting_on is self._beat

    @property
    def needed(self) -> bool:
        """Whether the drone obeys the loop and has not been braked to the end in its place."""
        return self._last(self._beat).command is not None

    def check(self, now: float) -> Beat | None:
        """Brake if the loop stands still; return what was done in its place, None for nothing."""
        beat = self._beat
        last = self._last(beat)
        silent = now - beat.time
        remaining = self._patience + self._blind_time - silent
        if last.motion is None or last.command is None or not silent >= self._patience:
            return None
        begins = last is beat
        if remaining < 0.0:
            if not begins:
                self._link.send(self._stop.hover)
            self._acting_on, self._own = beat, Beat(now, None, None)
            if begins:
                return None
            _log.warning("the %s has braked for as long as it may: the autopilot has the drone", self._name)
            return self._own
        motion = propagate(last.motion, last.command, max(now, last.motion.time), self._vehicle)
        command = self._stop.command(motion, remaining=remaining)
        self._link.send(command)
        self._acting_on, self._own = beat, Beat(now, motion, command)
        if begins:
            # After the command: writing a log may block.
            self.interventions += 1
            _log.error("the control loop has stood still for %.0f ms: the %s brakes", 1e3 * silent, self._name)
        return self._own

    def _last(self, beat: Beat) -> Beat:
        """Return what the drone was told last: `beat` by the loop, or something since in its place."""
        return self._own if self._acting_on is beat else beat
