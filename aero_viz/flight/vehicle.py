"""The simulated vehicles: what the planner's model commands, with lags, latency, drag and gusts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from aero_planner.config import PlannerConfig
from aero_planner.device.params import Params, pack
from aero_planner.device.records import bundle
from aero_viz.flight.motion import VehicleParameters
from aero_viz.flight.plants import plant_of
from aero_viz.flight.vehicle_kernels import Fleet, fly_kernel, rest_kernel
from aero_viz.flight.vehicle_model import PLANNED, VehicleModel


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
        control: control in effect, of a quadrotor thrust [N] and body rates [rad/s], vec4 [B].
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
        self._parameters, self._params = _pack(model, step=period / steps), _pack_params(model)
        count = len(positions)
        history = 1 + math.ceil(round(self._latency_max / self._parameters.step) / steps)
        quaternions = [(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)) for yaw in headings]
        with wp.ScopedDevice(device):
            self.position = wp.array(positions, dtype=wp.vec3)
            self.velocity = wp.zeros(count, dtype=wp.vec3)
            self.quaternion = wp.array(quaternions, dtype=wp.vec4)
            self.acceleration = wp.zeros(count, dtype=wp.vec3)
            self.control = wp.zeros(count, dtype=wp.vec4)
            self.recent_commands = wp.zeros((count, history), dtype=wp.vec4)
            self.wind = wp.zeros(count, dtype=wp.vec3)
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds or [0] * count], dtype=int)
            self.position_before = wp.clone(self.position)
            self.quaternion_before = wp.clone(self.quaternion)
            self.trail = wp.clone(wp.array([[p] * steps for p in positions], dtype=wp.vec3))
        names: Any = Fleet
        self._fleet = bundle(Fleet, **{name: getattr(self, name) for name in names.vars})
        self.rest()

    def rest(self) -> None:
        """Give the vehicles the controls of vehicles that have hovered, as those of another model mean nothing."""
        kernel = rest_kernel(plant_of(self.model.model))
        inputs = [self._parameters, self._params, self._fleet]
        wp.launch(kernel, len(self.position), inputs=inputs, device=self.position.device)

    def fly(self, commands: wp.array, *, active: wp.array, phase: float = 0.0, tick: int = 0) -> None:
        """Hold one command of a sequence for one period.

        Args:
            commands: sequences of controls of the model, vec4 [B, any].
            active: mask, int [B]; vehicles with 0 do not move.
            phase: position in the sequence of the command to hold, 0 for the first; between two commands, controls are
                interpolated linearly.
            tick: number of periods flown, which selects the random numbers of the gusts.
        """
        kernel = fly_kernel(plant_of(self.model.model))
        inputs = [self._parameters, self._params, tick, self._seeds, commands, phase, active]
        wp.launch(kernel, len(self.position), inputs=inputs, outputs=[self._fleet], device=self.position.device)

    def use(self, model: VehicleModel) -> None:
        """Use another model from now on, with the same time step. Where its controls mean something else, see `rest`.

        Raises:
            ValueError: its latency is longer than the commands are kept. Nothing changes.
        """
        if model.latency > self._latency_max:
            raise ValueError(
                f"drone.latency is {model.latency:g} s; during a flight it can be at most {self._latency_max:g} s. "
                "Start a flight with it for more."
            )
        self.model = model
        self._parameters, self._params = _pack(model, step=self._parameters.step), _pack_params(model)

    def state(self) -> list[wp.array]:
        """Return the arrays that a checkpoint holds."""
        state = [self.position, self.velocity, self.quaternion, self.acceleration, self.control]
        return [*state, self.recent_commands, self.wind, self.position_before, self.quaternion_before]


def _pack(model: VehicleModel, *, step: float) -> Any:
    """Return the `VehicleParameters` of a model that is integrated with `step` [s]."""
    parameters: Any = VehicleParameters()
    for name in (*PLANNED, "attitude_gain", "drag", "gust_speed"):
        setattr(parameters, name, getattr(model, name))
    parameters.step = step
    for name, lag in (("thrust_response", model.thrust_lag), ("rate_response", model.rate_lag)):
        setattr(parameters, name, 1.0 - math.exp(-parameters.step / lag) if lag > 0.0 else 1.0)
    parameters.latency = round(model.latency / parameters.step)
    parameters.gust_decay = math.exp(-parameters.step / model.gust_time)
    return parameters


def _pack_params(model: VehicleModel) -> Any:
    """Return the parameters that a vehicle model of the planner reads, with the values of the simulated vehicle."""
    record = pack(PlannerConfig())
    shared = {name: getattr(model, name) for name in (*PLANNED, "thrust_lag", "rate_lag")}
    params: Any = Params()
    for name in record.dtype.names:
        setattr(params, name, record[name].tolist())
    for name, value in (shared | dict(model.own)).items():
        setattr(params, name, value)
    return params
