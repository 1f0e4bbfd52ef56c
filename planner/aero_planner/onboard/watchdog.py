"""The watchdog, which flies and brakes in place of a control loop that has stalled."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.braking_path import BrakingPath
from aero_planner.onboard.dead_reckoning import MotionState, propagate
from aero_planner.onboard.interfaces import CommandSink
from aero_planner.onboard.settings import ResponseSettings
from aero_planner.onboard.stop_controller import StopCommand, StopController

_log = logging.getLogger(__name__)

UPCOMING_MAX = 16
"""Largest number of planned commands in a heartbeat."""

_LATE = 1.5
"""Control periods after which a tick is late."""

_ROUNDING = 1e-6


class Heartbeat(NamedTuple):
    """Knowledge of the control loop at the end of a tick, or of whoever acted in its place."""

    time: float
    """Start of the tick [s]."""
    motion: MotionState | None
    """Motion of the drone at that time, if known."""
    command: NDArray[np.float64] | None
    """Command that the drone obeys, or may obey, from then on, shape [4]; None if it does not obey the node."""
    upcoming: NDArray[np.float64] | None = None
    """Planned commands of the next control periods, shape [n, 4], n <= `UPCOMING_MAX`; None if no plan is flown."""
    path: BrakingPath | None = None
    """Braking path; None if no cloud is known."""
    thrust_gain: float = 1.0
    """See `aero_planner.onboard.thrust_estimate.ThrustEstimate`."""
    floor: float = -math.inf
    """Height below which a drone that is being stopped climbs, world frame [m]."""


class Watchdog:
    """Sends commands in place of a control loop that is late or has stalled.

    At the end of each tick, the loop reports its heartbeat. `check` must be called from elsewhere. When a tick is late,
    it sends the planned commands of the last heartbeat, or commands that stop the drone if no plan was flown. When the
    loop has been silent for `deadline`, it brakes and levels the drone by dead reckoning for `blind_time`, on the
    braking path of the last heartbeat if there is one. Then it commands to hover without turning and falls silent, so
    that the autopilot's own failsafe takes over. Braking commands contain the attitude, too: an autopilot that controls
    it ends level although dead reckoning drifts.

    Args:
        link: Connection to the autopilot.
        stop: Controller that brakes.
        vehicle: Vehicle model for dead reckoning.
        response: How the vehicle follows commands; None: at once.
        period: Period of the control loop [s].
        deadline: See `aero_planner.onboard.settings.LimitSettings` [s].
        blind_time: See `LimitSettings` [s].
        name: Name in the log.

    Attributes:
        interventions: Number of times that it braked in place of the loop.
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
        response: ResponseSettings | None = None,
        name: str = "watchdog",
    ) -> None:
        self.interventions = 0
        self._link = link
        self._stop = stop
        self._vehicle = vehicle
        self._response = response
        self._period = period
        self._deadline = deadline
        self._blind_time = blind_time
        self._name = name
        # Written only by the loop, which replaces it as a whole.
        self._heartbeat = Heartbeat(math.nan, None, None)
        # The last action in place of the loop, and the heartbeats after which it last acted and last braked.
        self._own_action = self._heartbeat
        self._acted_on: Heartbeat | None = None
        self._braked_on: Heartbeat | None = None

    def report(self, heartbeat: Heartbeat) -> None:
        """Report the end of a tick of the control loop."""
        self._heartbeat = heartbeat

    def silence(self, now: float) -> float:
        """Return how long the loop has been silent at `now` [s]; 0 before its first heartbeat."""
        return 0.0 if math.isnan(self._heartbeat.time) else now - self._heartbeat.time

    def declare_dead(self, now: float) -> None:
        """Declare at `now` [s] that the loop will not come back, so that `check` need not wait any longer."""
        self._deadline = min(self._deadline, self.silence(now))

    @property
    def braking(self) -> bool:
        """True if it has braked since the loop's newest heartbeat."""
        return self._braked_on is self._heartbeat

    @property
    def needed(self) -> bool:
        """True if the drone obeys the node and has not yet been stopped and handed back."""
        last = self._last_action(self._heartbeat)
        return last.motion is not None and last.command is not None

    def check(self, now: float) -> Heartbeat | None:
        """Send a command if the loop does not; return this action as a heartbeat, or None."""
        heartbeat = self._heartbeat
        last = self._last_action(heartbeat)
        silence = now - heartbeat.time
        if last.motion is None or last.command is None or not silence >= min(_LATE * self._period, self._deadline):
            return None
        motion = propagate(last.motion, last.command, max(now, last.motion.time), self._vehicle, self._response)
        if silence >= self._deadline:
            return self._brake(heartbeat, now, motion)
        if heartbeat.upcoming is None:
            # The loop was stopping the drone, whose last body rates must not last until the deadline.
            stop = self._stop_command(heartbeat, motion, self._time_left(silence))
            return self._send(heartbeat, now, motion, stop.control)
        step = int(silence / self._period + _ROUNDING)
        if step > len(heartbeat.upcoming):
            return None
        return self._send(heartbeat, now, motion, heartbeat.upcoming[step - 1], heartbeat.upcoming[step:])

    def _brake(self, heartbeat: Heartbeat, now: float, motion: MotionState) -> Heartbeat | None:
        silence = now - heartbeat.time
        remaining = self._time_left(silence)
        is_first = self._braked_on is not heartbeat
        self._braked_on = heartbeat
        if remaining < 0.0:
            self._acted_on, self._own_action = heartbeat, Heartbeat(now, None, None)
            if is_first:
                return None
            self._link.send(*self._stop.level(motion))
            _log.warning("the %s has braked for as long as it may; the autopilot now has control", self._name)
            return self._own_action
        stop = self._stop_command(heartbeat, motion, remaining)
        action = self._send(heartbeat, now, motion, stop.control, attitude=stop.attitude)
        if is_first:
            self.interventions += 1
            _log.error("the control loop has stalled for %.0f ms: the %s brakes", 1e3 * silence, self._name)
        return action

    def _stop_command(self, heartbeat: Heartbeat, motion: MotionState, remaining: float) -> StopCommand:
        return self._stop.command(motion, path=heartbeat.path, floor=heartbeat.floor, remaining=remaining)

    def _time_left(self, silence: float) -> float:
        """Return the time until the drone is handed back [s]."""
        return self._deadline + self._blind_time - silence

    def _send(
        self,
        heartbeat: Heartbeat,
        now: float,
        motion: MotionState,
        command: NDArray[np.float64],
        upcoming: NDArray[np.float64] | None = None,
        attitude: NDArray[np.float64] | None = None,
    ) -> Heartbeat:
        self._link.send(command, attitude)
        self._acted_on = heartbeat
        self._own_action = heartbeat._replace(time=now, motion=motion, command=command, upcoming=upcoming)
        return self._own_action

    def _last_action(self, heartbeat: Heartbeat) -> Heartbeat:
        """Return the last command to the drone: by the loop, or in its place since then."""
        return self._own_action if self._acted_on is heartbeat else heartbeat
