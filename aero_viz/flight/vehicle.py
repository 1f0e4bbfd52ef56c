"""The simulated quadrotor: the planner's model with a finer step, and optional lags, latency, drag and gusts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from aero_viz.flight.vehicle_kernels import VehicleParameters, fly_kernel
from aero_viz.flight.vehicle_model import VehicleModel


class Vehicle:
    """B equal vehicles that hover at first.

    Args:
        model: model of the vehicles.
        positions: initial positions [m], [B, 3], world frame.
        headings: initial yaw angles [rad], [B].
        period: time for which a command is held [s].
        device: Warp device.
        seeds: seeds of the gusts, one per vehicle; None is 0 for all.
        latency_max: largest latency that `use` can give them later [s].

    Attributes:
        position, velocity, acceleration: vec3 [B], world frame, SI.
        quaternion: body to world, w, x, y, z, vec4 [B].
        control: thrust [N] and body rates [rad/s] in effect, vec4 [B].
        recent_commands: the last commands, newest first, vec4 [B, H].
        wind: vec3 [B], world frame [m/s].
        position_before, quaternion_before: pose before the last command.
        trail: positions after each integration step of the last command, vec3 [B, S].
    """

    def __init__(
        self,
        model: VehicleModel,
        positions: Any,
        headings: Any,
        *,
        period: float,
        device: Any,
        seeds: Sequence[int] | None = None,
        latency_max: float = 0.0,
    ) -> None:
        self.model = model
        self._latency_max = max(latency_max, model.latency)
        steps = math.ceil(period / model.step - 1e-6)
        self._parameters = _pack(model, step=period / steps)
        count = len(positions)
        hover = wp.vec4(model.mass * model.gravity, 0.0, 0.0, 0.0)
        history = 1 + math.ceil(round(self._latency_max / self._parameters.step) / steps)
        quaternions = [(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)) for yaw in headings]
        with wp.ScopedDevice(device):
            self.position = wp.array(positions, dtype=wp.vec3)
            self.velocity = wp.zeros(count, dtype=wp.vec3)
            self.quaternion = wp.array(quaternions, dtype=wp.vec4)
            self.acceleration = wp.zeros(count, dtype=wp.vec3)
            self.control = wp.full(count, hover, dtype=wp.vec4)
            self.recent_commands = wp.full((count, history), hover, dtype=wp.vec4)
            self.wind = wp.zeros(count, dtype=wp.vec3)
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds or [0] * count], dtype=int)
            self.position_before = wp.clone(self.position)
            self.quaternion_before = wp.clone(self.quaternion)
            self.trail = wp.clone(wp.array([[p] * steps for p in positions], dtype=wp.vec3))

    def fly(self, commands: wp.array, *, active: wp.array, phase: float = 0.0, tick: int = 0) -> None:
        """Hold one command of a sequence for one period.

        Args:
            commands: sequences of F_t [N] and omega [rad/s], vec4 [B, any].
            active: mask, int [B]; vehicles with 0 do not move.
            phase: position in the sequence of the command to hold, 0 for the first; between two commands, controls are
                interpolated linearly.
            tick: number of periods flown, which selects the random numbers of the gusts.
        """
        inputs = [self._parameters, tick, self._seeds, commands, phase, active]
        wp.launch(
            fly_kernel,
            len(self.position),
            inputs=inputs,
            outputs=[*self.state(), self.trail],
            device=self.position.device,
        )

    def use(self, model: VehicleModel) -> None:
        """Use another model from now on, with the same time step.

        Raises:
            ValueError: its latency is longer than the commands are kept. Nothing changes.
        """
        if model.latency > self._latency_max:
            raise ValueError(
                f"drone.latency is {model.latency:g} s; during a flight it can be at most {self._latency_max:g} s. "
                "Start a flight with it for more."
            )
        self.model, self._parameters = model, _pack(model, step=self._parameters.step)

    def state(self) -> list[wp.array]:
        """Return the arrays that a checkpoint holds, in the order of the kernel's arguments."""
        state = [self.position, self.velocity, self.quaternion, self.acceleration, self.control]
        return [*state, self.recent_commands, self.wind, self.position_before, self.quaternion_before]


def _pack(model: VehicleModel, *, step: float) -> Any:
    """Return the `VehicleParameters` of a model that is integrated with `step` [s]."""
    parameters: Any = VehicleParameters()
    for name in ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max", "drag", "gust_speed"):
        setattr(parameters, name, getattr(model, name))
    parameters.step = step
    for name, lag in (("thrust_response", model.thrust_lag), ("rate_response", model.rate_lag)):
        setattr(parameters, name, 1.0 - math.exp(-parameters.step / lag) if lag > 0.0 else 1.0)
    parameters.latency = round(model.latency / parameters.step)
    parameters.gust_decay = math.exp(-parameters.step / model.gust_time)
    return parameters
