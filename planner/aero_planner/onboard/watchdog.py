"""What brakes the drone when the control loop does not."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.dead_reckoning import MotionState, StopController, propagate
from aero_planner.onboard.vehicle_link import CommandSink

__all__ = ["AHEAD", "Heartbeat", "Watchdog"]

_log = logging.getLogger(__name__)

AHEAD = 16
"""Commands of the plan that a beat tells ahead, at most."""

_LATE = 1.5
"""Control periods after which a tick is late."""

_ROUNDING = 1e-6


class Heartbeat(NamedTuple):
    """What is known at the end of a tick of the control loop, or of one in its place."""

    time: float
    """When the tick began [s]."""
    motion: MotionState | None
    """Of the drone, where known, then."""
    command: NDArray[np.float64] | None
    """What it obeys from then on, shape [4]; None where it does not obey us."""
    ahead: NDArray[np.float64] | None = None
    """What the plan says for the control periods to come, shape [n, 4], n <= `AHEAD`; None where none is flown."""


class Watchdog:
    """Speaks in the place of a control loop that stands still.

    The loop says at the end of each tick where the drone is, whether it obeys, and what the plan says next. `check`,
    called by somebody else than the loop, goes on with the plan when a tick is late. `deadline` after the last tick
    began, it brakes and levels by dead reckoning, for `blind_time`. Then it says to hover without turning and is
    silent: the autopilot's own failsafe takes over.

    Args:
        link: to the autopilot.
        stop: how to brake.
        vehicle: the model to reckon with.
        period: of the control loop [s].
        deadline, blind_time: see `aero_planner.onboard.settings.LimitSettings` [s].
        name: what the log calls it.
    """

    def __init__(
        self,
        link: CommandSink,
        stop: StopController,
        vehicle: VehicleConfig,
        *,
        period: float,
        deadline: float,
        blind_time: float,
        name: str = "watchdog",
    ) -> None:
        self._link = link
        self._stop = stop
        self._vehicle = vehicle
        self._period = period
        self._patience = deadline
        self._blind_time = blind_time
        self._name = name
        # Replaced whole by the loop and only read here.
        self._beat = Heartbeat(math.nan, None, None)
        # What was told the drone last in the loop's place, after which beat, and after which one to brake.
        self._own = self._beat
        self._acted_on: Heartbeat | None = None
        self._braked_on: Heartbeat | None = None
        self.interventions = 0
        """Times that the loop was replaced."""

    def beat(self, beat: Heartbeat) -> None:
        """End a tick of the control loop."""
        self._beat = beat

    def silence(self, now: float) -> float:
        """Return for how long the loop has been silent at `now` [s]; 0 before its first beat."""
        return 0.0 if math.isnan(self._beat.time) else now - self._beat.time

    def give_up(self, now: float) -> None:
        """Say, at `now` [s], that the loop will not come back: `check` need not wait any longer."""
        self._patience = min(self._patience, self.silence(now))

    @property
    def braking(self) -> bool:
        """Whether it has braked since the loop's newest beat."""
        return self._braked_on is self._beat

    @property
    def needed(self) -> bool:
        """Whether the drone obeys the loop and has not been braked to the end in its place."""
        return _obeyed(self._last(self._beat))

    def check(self, now: float) -> Heartbeat | None:
        """Speak if the loop does not; return what was said, as a beat, or None."""
        beat = self._beat
        last = self._last(beat)
        silent = now - beat.time
        if last.motion is None or last.command is None or not silent >= min(_LATE * self._period, self._patience):
            return None
        motion = propagate(last.motion, last.command, max(now, last.motion.time), self._vehicle)
        if silent >= self._patience:
            return self._brake(beat, now, motion)
        step = int(silent / self._period + _ROUNDING)
        if beat.ahead is None or step > len(beat.ahead):
            return None
        return self._say(beat, Heartbeat(now, motion, beat.ahead[step - 1], beat.ahead[step:]))

    def _brake(self, beat: Heartbeat, now: float, motion: MotionState) -> Heartbeat | None:
        silent = now - beat.time
        remaining = self._patience + self._blind_time - silent
        begins = self._braked_on is not beat
        self._braked_on = beat
        if remaining < 0.0:
            self._acted_on, self._own = beat, Heartbeat(now, None, None)
            if begins:
                return None
            self._link.send(self._stop.hover)
            _log.warning("the %s has braked for as long as it may: the autopilot has the drone", self._name)
            return self._own
        said = self._say(beat, Heartbeat(now, motion, self._stop.command(motion, remaining=remaining)))
        if begins:
            self.interventions += 1
            _log.error("the control loop has stood still for %.0f ms: the %s brakes", 1e3 * silent, self._name)
        return said

    def _say(self, beat: Heartbeat, own: Heartbeat) -> Heartbeat:
        assert own.command is not None
        self._link.send(own.command)
        self._acted_on, self._own = beat, own
        return own

    def _last(self, beat: Heartbeat) -> Heartbeat:
        """Return what the drone was told last: `beat` by the loop, or something since in its place."""
        return self._own if self._acted_on is beat else beat


def _obeyed(beat: Heartbeat) -> bool:
    return beat.motion is not None and beat.command is not None
