"""Present state of the drone: the newest measured state, propagated with the planner's vehicle model."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import VehicleConfig
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import ResponseSettings
from aero_planner.quaternions import integrate_rates, rotate

Array = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_LAG_STEP = 0.01
"""Longest step of the propagation with lags [s]."""
_MAX_INTERVAL = 0.1
"""Longest time between two states that are compared [s]."""
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
    control: Array | None = None
    """Thrust [N] and body rates [rad/s] in effect, shape [4]; None if unknown: the next command then acts at once."""

    @property
    def is_finite(self) -> bool:
        """True if no number is NaN or infinite."""
        return bool(np.isfinite([self.time, *self.position, *self.velocity, *self.quaternion]).all())

    @property
    def speed(self) -> float:
        """Norm of the velocity [m/s]."""
        return float(np.linalg.norm(self.velocity))


def compared_interval(previous: VehicleSample, predicted: MotionState | None, sample: VehicleSample) -> float | None:
    """Return the time between two states [s], None if the second one says nothing about the model.

    Args:
        previous: The state from which the motion was predicted.
        predicted: Prediction from the commands for the time of `sample`; without a control, the vehicle did not obey
            them.
        sample: The new state.
    """
    interval = sample.time - previous.time
    is_comparable = sample.resets == previous.resets and 0.0 < interval <= _MAX_INTERVAL
    return interval if is_comparable and predicted is not None and predicted.control is not None else None


def acceleration(quaternion: ArrayLike, thrust: float, vehicle: VehicleConfig) -> Array:
    """Return dv = R(q) [0, 0, F_t] / m + g [m/s^2], shape [3], for the thrust F_t [N]."""
    return rotate(quaternion, (thrust / vehicle.mass) * _UP) - vehicle.gravity * _UP


def propagate(
    motion: MotionState,
    command: ArrayLike | None,
    time: float,
    vehicle: VehicleConfig,
    response: ResponseSettings | None = None,
) -> MotionState:
    """Return the motion at `time` [s] if `command`, F_t [N] and omega [rad/s], acts until then.

    Thrust and rates approach the command as first-order lags, and drag slows the drone down. Without `response` they
    follow at once, and there is no drag. The attitude is exact for the mean rates; the thrust acts in its direction at
    half time, in steps of at most 10 ms if there are lags. Without a command the velocity is constant.
    """
    dt = time - motion.time
    if command is None:
        return MotionState(time, motion.position + dt * motion.velocity, motion.velocity, motion.quaternion)
    target = np.asarray(command, dtype=np.float64)
    if response is None:
        return _step(motion, target, target, time, vehicle, 0.0)
    lags = np.array([response.thrust_lag, *[response.rate_lag] * 3])
    steps = max(1, math.ceil(dt / _LAG_STEP - 1e-6))
    for k in range(steps):
        end = time if k == steps - 1 else motion.time + dt / steps
        control = target if motion.control is None else motion.control
        reached, mean = _lagged(control, target, lags, end - motion.time)
        motion = _step(motion, mean, reached, end, vehicle, response.drag)
    return motion


def _lagged(control: Array, target: Array, lags: Array, dt: float) -> tuple[Array, Array]:
    """Return the control that first-order lags reach after `dt` [s], and its mean until then; each has shape [4]."""
    share = dt / np.maximum(lags, 1e-9)
    decay = np.exp(-share)
    mean_decay = np.where(share > 0.0, (1.0 - decay) / np.maximum(share, 1e-12), 1.0)
    return target + decay * (control - target), target + mean_decay * (control - target)


def _step(
    motion: MotionState, mean: Array, reached: Array, time: float, vehicle: VehicleConfig, drag: float
) -> MotionState:
    """Return the motion at `time` [s] after the control `mean`; `reached` is in effect then."""
    dt = time - motion.time
    middle = integrate_rates(motion.quaternion, mean[1:], 0.5 * dt)
    change = dt * (acceleration(middle, float(mean[0]), vehicle) - drag * motion.velocity)
    quaternion = integrate_rates(motion.quaternion, mean[1:], dt)
    return MotionState(
        time,
        motion.position + dt * motion.velocity + 0.5 * dt * change,
        motion.velocity + change,
        quaternion / np.linalg.norm(quaternion),
        reached,
    )


class DeadReckoning:
    """Propagates the newest state to the present with the commands sent since. Not thread-safe."""

    def __init__(self, vehicle: VehicleConfig, response: ResponseSettings | None = None) -> None:
        self._vehicle = vehicle
        self._response = response
        self._commands: deque[tuple[float, Array | None]] = deque(maxlen=_COMMANDS)
        self._measured: MotionState | None = None
        self._propagated: MotionState | None = None

    def correct(self, sample: VehicleSample) -> None:
        """Continue from a measured state, with the thrust and the rates that the commands have led to."""
        state = sample.state
        position, velocity, quaternion = (
            np.asarray(value, dtype=np.float64) for value in (state.position, state.velocity, state.quaternion)
        )
        predicted = self.at(sample.time)
        control = None if predicted is None else predicted.control
        self._measured = self._propagated = MotionState(sample.time, position, velocity, quaternion, control)
        while len(self._commands) > 1 and self._commands[1][0] <= sample.time:
            self._commands.popleft()

    def add_command(self, time: float, command: ArrayLike | None) -> None:
        """Add the command that the drone obeys from `time` [s] on; None if it does not obey the node."""
        self._commands.append((time, None if command is None else np.array(command, dtype=np.float64)))

    def forget_commands(self, time: float) -> None:
        """Treat the commands from `time` [s] on as unknown, until the next one is added.

        `time` must not be earlier than the newest command.
        """
        if self._commands and self._commands[-1][1] is not None:
            self.add_command(time, None)
            self._propagated = self._measured

    def at(self, time: float) -> MotionState | None:
        """Return the motion at `time` [s]; None before the first state.

        For an earlier time than that of the newest state, it is the newest state.
        """
        if self._propagated is None or self._measured is None:
            return None
        if time < self._propagated.time:
            self._propagated = self._measured
        motion = self._propagated
        for i, (_, command) in enumerate(self._commands):
            end = min(self._commands[i + 1][0] if i + 1 < len(self._commands) else time, time)
            if end > motion.time:
                motion = propagate(motion, command, end, self._vehicle, self._response)
        self._propagated = motion = motion if motion.time >= time else propagate(motion, None, time, self._vehicle)
        return motion
