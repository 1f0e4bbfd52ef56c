"""Where the drone is now, and how to bring it to rest: the planner's vehicle model, one step at a time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.settings import BrakeSettings
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.quaternions import conjugate, integrate_rates, rotate

__all__ = ["DeadReckoning", "MotionState", "StopController", "acceleration", "propagate"]

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_LEAST_LIFT = 0.3
"""Of the weight, while braking: a drone that is to sink fast must not turn over."""
_LEVEL_TIME = 3.0
"""For levelling, in time constants of the attitude: of 30 deg of tilt 1.5 deg are left."""
_REMEMBERED = 600
"""Commands, those of 3 s at the fastest control rate: a state carried on by them is no older than limits.state_age."""


@dataclass(frozen=True, eq=False)
class MotionState:
    """State at one time, float64, world frame."""

    time: float
    """Host time [s]."""
    position: Array
    """[m], shape [3]."""
    velocity: Array
    """[m/s], shape [3]."""
    quaternion: Array
    """Body to world, w x y z, unit, shape [4]."""

    @property
    def finite(self) -> bool:
        """Whether every number is."""
        return bool(np.isfinite([self.time, *self.position, *self.velocity, *self.quaternion]).all())

    @property
    def speed(self) -> float:
        """[m/s]"""
        return float(np.linalg.norm(self.velocity))


def acceleration(quaternion: ArrayLike, thrust: float, vehicle: VehicleConfig) -> Array:
    """Return dv = R(q) [0, 0, F_t] / m + g [m/s^2], shape [3]."""
    return rotate(quaternion, (thrust / vehicle.mass) * _UP) - vehicle.gravity * _UP


def propagate(motion: MotionState, command: ArrayLike | None, time: float, vehicle: VehicleConfig) -> MotionState:
    """Return the motion at `time` [s] when `command`, F_t [N] and omega [rad/s], acts until then.

    The attitude is exact; the thrust points as it does halfway. Without a command the velocity stays.
    """
    dt = time - motion.time
    if command is None:
        return MotionState(time, motion.position + dt * motion.velocity, motion.velocity, motion.quaternion)
    values = np.asarray(command, dtype=np.float64)
    change = dt * acceleration(integrate_rates(motion.quaternion, values[1:], 0.5 * dt), float(values[0]), vehicle)
    quaternion = integrate_rates(motion.quaternion, values[1:], dt)
    return MotionState(
        time,
        motion.position + dt * motion.velocity + 0.5 * dt * change,
        motion.velocity + change,
        quaternion / np.linalg.norm(quaternion),
    )


class DeadReckoning:
    """The newest state, carried on to the present by the commands that were sent since. One thread at a time."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle = vehicle
        self._commands: deque[tuple[float, Array | None]] = deque(maxlen=_REMEMBERED)
        self._base: MotionState | None = None
        self._carried: MotionState | None = None

    def correct(self, sample: VehicleSample) -> None:
        """Take over a measured state."""
        state = sample.state
        position, velocity, quaternion = (
            np.asarray(value, dtype=np.float64) for value in (state.position, state.velocity, state.quaternion)
        )
        self._base = self._carried = MotionState(sample.time, position, velocity, quaternion)
        while len(self._commands) > 1 and self._commands[1][0] <= sample.time:
            self._commands.popleft()

    def command(self, time: float, command: ArrayLike | None) -> None:
        """Say what the autopilot obeys from `time` [s] on; None where it does not obey us."""
        self._commands.append((time, None if command is None else np.array(command, dtype=np.float64)))

    def at(self, time: float) -> MotionState | None:
        """Return the motion at `time` [s], not before the newest state; None before the first."""
        if self._carried is None or self._base is None:
            return None
        if time < self._carried.time:
            self._carried = self._base
        motion = self._carried
        for i, (_, command) in enumerate(self._commands):
            end = min(self._commands[i + 1][0] if i + 1 < len(self._commands) else time, time)
            if end > motion.time:
                motion = propagate(motion, command, end, self._vehicle)
        self._carried = motion = motion if motion.time >= time else propagate(motion, None, time, self._vehicle)
        return motion


class StopController:
    """Brings the drone to rest, level, and keeps it at a place: thrust and body rates from the velocity.

    The wanted acceleration is -v / tau + k (p_hold - p), bounded; the thrust vector that gives it is turned to at a
    rate in proportion to the angle. The heading is left alone.

    Args:
        vehicle: mass, gravity and bounds of the controls.
        settings: see `BrakeSettings`.
    """

    def __init__(self, vehicle: VehicleConfig, settings: BrakeSettings) -> None:
        self._vehicle = vehicle
        self._settings = settings

    @property
    def hover(self) -> Array:
        """The command of a level drone at rest, shape [4]."""
        return np.array([self._vehicle.mass * self._vehicle.gravity, 0.0, 0.0, 0.0])

    def command(self, motion: MotionState, *, hold: Array | None = None, remaining: float = math.inf) -> Array:
        """Return thrust F_t [N] and body rates omega [rad/s], shape [4], within the vehicle's bounds.

        Args:
            motion: state now.
            hold: where to stay [m], shape [3], world frame; None brakes only.
            remaining: time until the last command, `hover` [s], which leaves the tilt as it is: the end of it goes into
                levelling, whatever the speed is then.
        """
        vehicle, settings = self._vehicle, self._settings
        wanted = -motion.velocity / settings.time_constant
        if remaining <= _LEVEL_TIME / settings.attitude_gain:
            wanted, hold = np.zeros(3), None
        if hold is not None:
            wanted = wanted + settings.position_gain * (hold - motion.position)
        size = float(np.linalg.norm(wanted))
        if size > settings.acceleration:
            wanted = wanted * (settings.acceleration / size)
        force = vehicle.mass * (wanted + vehicle.gravity * _UP)
        force[2] = max(force[2], _LEAST_LIFT * vehicle.mass * vehicle.gravity)
        up = rotate(motion.quaternion, _UP)
        direction = force / np.linalg.norm(force)
        axis = np.cross(up, direction)
        sine, cosine = float(np.linalg.norm(axis)), float(up @ direction)
        # Upside down every axis will do.
        axis = axis / sine if sine > 1e-9 else rotate(motion.quaternion, np.array([1.0, 0.0, 0.0]))
        turn = settings.attitude_gain * math.atan2(sine, cosine)
        rates = rotate(conjugate(motion.quaternion), turn * axis)
        limit = vehicle.rate_xy_max
        return np.array(
            [
                min(max(float(force @ up), vehicle.thrust_min), vehicle.thrust_max),
                min(max(rates[0], -limit), limit),
                min(max(rates[1], -limit), limit),
                0.0,
            ]
        )
