"""Where the drone is now: the newest measured state, propagated with the planner's vehicle model."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.quaternions import integrate_rates, rotate

__all__ = ["DeadReckoning", "MotionState", "acceleration", "propagate"]

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_COMMANDS = 600
"""Commands that are kept, those of 3 s at the highest control rate: no state older than limits.state_age is used."""


@dataclass(frozen=True, eq=False)
class MotionState:
    """Position, velocity and attitude at one time, float64, world frame."""

    time: float
    """Host time [s]."""
    position: Array
    """[m], shape [3]."""
    velocity: Array
    """[m/s], shape [3]."""
    quaternion: Array
    """Body to world, w x y z, unit, shape [4]."""

    @property
    def is_finite(self) -> bool:
        """True if no number is NaN or infinite."""
        return bool(np.isfinite([self.time, *self.position, *self.velocity, *self.quaternion]).all())

    @property
    def speed(self) -> float:
        """Norm of the velocity [m/s]."""
        return float(np.linalg.norm(self.velocity))


def acceleration(quaternion: ArrayLike, thrust: float, vehicle: VehicleConfig) -> Array:
    """Return dv = R(q) [0, 0, F_t] / m + g [m/s^2], shape [3], for the thrust F_t [N]."""
    return rotate(quaternion, (thrust / vehicle.mass) * _UP) - vehicle.gravity * _UP


def propagate(motion: MotionState, command: ArrayLike | None, time: float, vehicle: VehicleConfig) -> MotionState:
    """Return the motion at `time` [s] if `command`, F_t [N] and omega [rad/s], acts until then.

    The attitude is exact; the thrust acts in its direction at half time. Without a command the velocity is constant.
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
    """Propagates the newest state to the present with the commands sent since. Not thread-safe."""

    def __init__(self, vehicle: VehicleConfig) -> None:
        self._vehicle = vehicle
        self._commands: deque[tuple[float, Array | None]] = deque(maxlen=_COMMANDS)
        self._measured: MotionState | None = None
        self._propagated: MotionState | None = None

    def correct(self, sample: VehicleSample) -> None:
        """Continue from a measured state."""
        state = sample.state
        position, velocity, quaternion = (
            np.asarray(value, dtype=np.float64) for value in (state.position, state.velocity, state.quaternion)
        )
        self._measured = self._propagated = MotionState(sample.time, position, velocity, quaternion)
        while len(self._commands) > 1 and self._commands[1][0] <= sample.time:
            self._commands.popleft()

    def add_command(self, time: float, command: ArrayLike | None) -> None:
        """Add the command that the drone obeys from `time` [s] on; None if it does not obey the node."""
        self._commands.append((time, None if command is None else np.array(command, dtype=np.float64)))

    def at(self, time: float) -> MotionState | None:
        """Return the motion at `time` [s], which must not precede the newest state; None before the first state."""
        if self._propagated is None or self._measured is None:
            return None
        if time < self._propagated.time:
            self._propagated = self._measured
        motion = self._propagated
        for i, (_, command) in enumerate(self._commands):
            end = min(self._commands[i + 1][0] if i + 1 < len(self._commands) else time, time)
            if end > motion.time:
                motion = propagate(motion, command, end, self._vehicle)
        self._propagated = motion = motion if motion.time >= time else propagate(motion, None, time, self._vehicle)
        return motion
