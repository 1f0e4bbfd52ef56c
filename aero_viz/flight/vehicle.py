"""The simulated quadrotor: the planner's model at a finer step, with optional lags, latency, drag and gusts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from aero_planner import PlannerConfig
from aero_planner.config import VehicleConfig
from aero_planner.config.parameter import ParameterSection, live

__all__ = ["PLANNED", "Vehicle", "VehicleModel"]

PLANNED = ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max")
"""Parameters of the vehicle that the planner knows, too: where nothing else is said, it is right about them."""

wp.set_module_options({"enable_backward": False})

GUSTS = wp.constant(0x47757374)  # tells the gusts' random numbers from those of the other parts of a flight


def _planned(name: str) -> Any:
    """Return the field of a parameter that the planner's own model of the vehicle has, too."""
    known = VehicleConfig.__dataclass_fields__[name]
    return field(default=known.default, metadata=known.metadata)


@dataclass(frozen=True)
class VehicleModel(ParameterSection, section="drone"):
    """Parameters of the simulated vehicle; the defaults are the planner's own model: no lags, latency, drag, gusts.

    Raises:
        ValueError: a parameter is outside its bounds or contradicts another one.
    """

    mass: float = _planned("mass")
    gravity: float = _planned("gravity")
    thrust_min: float = _planned("thrust_min")
    thrust_max: float = _planned("thrust_max")
    rate_xy_max: float = _planned("rate_xy_max")
    rate_z_max: float = _planned("rate_z_max")
    thrust_lag: float = live(0.0, "s", 0.0, 10.0, "Time constant of the thrust's first-order response; 0: at once.")
    rate_lag: float = live(0.0, "s", 0.0, 10.0, "Time constant of the body rates' first-order response; 0: at once.")
    drag: float = live(0.0, "1/s", 0.0, 100.0, "Linear drag in dv = .. - k (v - w), with w the wind.", symbol="k")
    latency: float = live(0.0, "s", 0.0, 10.0, "Time from a command to its effect, rounded to whole integration steps.")
    gust_speed: float = live(
        0.0, "m/s", 0.0, 100.0, "Standard deviation of the wind in each axis; it acts through the drag.", symbol="w"
    )
    gust_time: float = live(
        1.0, "s", 1e-3, 1e9, "Correlation time of the wind, a first-order process dw = -w / gust_time dt + noise: the "
        "longitudinal form of the Dryden spectrum with gust_time = L / V.",
    )  # fmt: skip
    step: float = live(0.005, "s", 1e-4, 0.1, "Longest integration step.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.thrust_min > self.thrust_max:
            raise ValueError(f"drone.thrust_min is {self.thrust_min:g} N; it must not exceed drone.thrust_max, "
                             f"which is {self.thrust_max:g} N.")  # fmt: skip
        if self.gust_speed > 0.0 and self.drag == 0.0:
            raise ValueError("drone.gust_speed has no effect without drag; set drone.drag too, such as 0.3 1/s.")

    @classmethod
    def from_config(cls, config: PlannerConfig, **changes: float) -> VehicleModel:
        """Return the vehicle that the planner of `config` assumes, with `changes`."""
        return cls(**{name: getattr(config.vehicle, name) for name in PLANNED} | changes)


@wp.struct
class VehicleParameters:
    """`VehicleModel` for kernels. The responses are the shares of a change that happen within one step."""

    mass: float
    gravity: float
    thrust_min: float
    thrust_max: float
    rate_xy_max: float
    rate_z_max: float
    thrust_response: float
    rate_response: float
    drag: float
    step: float
    latency: int
    """Integration steps."""
    gust_keep: float
    """Share of the wind that is left after one step."""
    gust_speed: float


@wp.struct
class Motion:
    """p [m], v [m/s], q (w, x, y, z, body to world) of the state or their time derivatives."""

    position: wp.vec3
    velocity: wp.vec3
    quaternion: wp.vec4


@wp.func
def thrust_acceleration(q: wp.vec4, control: wp.vec4, mass: float):
    """R(q) [0, 0, F_t] / m [m/s^2]."""
    axis = wp.vec3(
        2.0 * (q[1] * q[3] + q[0] * q[2]),
        2.0 * (q[2] * q[3] - q[0] * q[1]),
        q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3],
    )
    return (control[0] / mass) * axis


@wp.func
def acceleration_of(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    gravity = wp.vec3(0.0, 0.0, v.gravity)
    return thrust_acceleration(state.quaternion, control, v.mass) - gravity - v.drag * (state.velocity - wind)


@wp.func
def derivative(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """dp = v; dv = R(q) [0, 0, F_t] / m + g - k (v - w); dq = 1/2 q (x) [0, omega]."""
    q = state.quaternion
    x = control[1]
    y = control[2]
    z = control[3]
    rate = Motion()
    rate.position = state.velocity
    rate.velocity = acceleration_of(v, state, control, wind)
    rate.quaternion = 0.5 * wp.vec4(
        -q[1] * x - q[2] * y - q[3] * z,
        q[0] * x + q[2] * z - q[3] * y,
        q[0] * y + q[3] * x - q[1] * z,
        q[0] * z + q[1] * y - q[2] * x,
    )
    return rate


@wp.func
def moved(state: Motion, rate: Motion, time: float):
    result = Motion()
    result.position = state.position + time * rate.position
    result.velocity = state.velocity + time * rate.velocity
    result.quaternion = state.quaternion + time * rate.quaternion
    return result


@wp.func
def runge_kutta(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """One RK4 step under constant controls and wind; the quaternion is normalised."""
    h = v.step
    k1 = derivative(v, state, control, wind)
    k2 = derivative(v, moved(state, k1, 0.5 * h), control, wind)
    k3 = derivative(v, moved(state, k2, 0.5 * h), control, wind)
    k4 = derivative(v, moved(state, k3, h), control, wind)
    mean = Motion()
    mean.position = (k1.position + 2.0 * k2.position + 2.0 * k3.position + k4.position) / 6.0
    mean.velocity = (k1.velocity + 2.0 * k2.velocity + 2.0 * k3.velocity + k4.velocity) / 6.0
    mean.quaternion = (k1.quaternion + 2.0 * k2.quaternion + 2.0 * k3.quaternion + k4.quaternion) / 6.0
    result = moved(state, mean, h)
    result.quaternion = wp.normalize(result.quaternion)
    return result


@wp.func
def clamped(v: VehicleParameters, control: wp.vec4):
    return wp.vec4(
        wp.clamp(control[0], v.thrust_min, v.thrust_max),
        wp.clamp(control[1], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(control[2], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(control[3], -v.rate_z_max, v.rate_z_max),
    )


@wp.func
def command_at(commands: wp.array2d(dtype=wp.vec4), b: int, phase: float):
    """Controls at a place between two of the sequence, linearly; the last one after the end."""
    last = commands.shape[1] - 1
    i = int(phase)
    command = commands[b, wp.min(i, last)]
    return command + (phase - float(i)) * (commands[b, wp.min(i + 1, last)] - command)


@wp.kernel
def fly_kernel(
    v: VehicleParameters,
    commands: wp.array2d(dtype=wp.vec4),
    phase: float,
    tick: int,
    seeds: wp.array(dtype=int),
    finished: wp.array(dtype=int),
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    accelerations: wp.array(dtype=wp.vec3),
    controls: wp.array(dtype=wp.vec4),
    recent: wp.array2d(dtype=wp.vec4),
    winds: wp.array(dtype=wp.vec3),
    positions_before: wp.array(dtype=wp.vec3),
    quaternions_before: wp.array(dtype=wp.vec4),
    trail: wp.array2d(dtype=wp.vec3),
):
    b = wp.tid()
    if finished[b] != 0:
        return
    state = Motion()
    state.position = positions[b]
    state.velocity = velocities[b]
    state.quaternion = quaternions[b]
    positions_before[b] = state.position
    quaternions_before[b] = state.quaternion
    for j in range(recent.shape[1] - 1, 0, -1):
        recent[b, j] = recent[b, j - 1]
    recent[b, 0] = clamped(v, command_at(commands, b, phase))
    steps = trail.shape[1]
    random = wp.rand_init(seeds[b] ^ GUSTS, tick)
    wind = winds[b]
    if tick == 0:
        wind = v.gust_speed * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
    spread = v.gust_speed * wp.sqrt(1.0 - v.gust_keep * v.gust_keep)
    response = wp.vec4(v.thrust_response, v.rate_response, v.rate_response, v.rate_response)
    control = controls[b]
    for s in range(steps):
        if v.gust_speed > 0.0:
            wind = v.gust_keep * wind + spread * wp.vec3(wp.randn(random), wp.randn(random), wp.randn(random))
        command = recent[b, (wp.max(v.latency - s, 0) + steps - 1) // steps]
        control = control + wp.cw_mul(response, command - control)
        state = runge_kutta(v, state, control, wind)
        trail[b, s] = state.position
    positions[b] = state.position
    velocities[b] = state.velocity
    quaternions[b] = state.quaternion
    accelerations[b] = acceleration_of(v, state, control, wind)
    controls[b] = control
    winds[b] = wind


class Vehicle:
    """B equal vehicles, at rest and hovering at first.

    Args:
        model: of the vehicles.
        positions: first positions [m], [B, 3], world frame.
        headings: first yaw angles [rad], [B].
        period: time over which a command is held [s].
        device: Warp device.
        seeds: of the gusts, one per vehicle; None is 0 for all.

    Attributes:
        position, velocity, acceleration: vec3 [B], world frame, SI.
        quaternion: body to world, w, x, y, z, vec4 [B].
        control: thrust [N] and body rates [rad/s] in effect, vec4 [B].
        recent: the last commands, newest first, vec4 [B, H].
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
    ) -> None:
        self.model = model
        steps = math.ceil(period / model.step - 1e-6)
        parameters = VehicleParameters()
        for name in ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max", "drag", "gust_speed"):
            setattr(parameters, name, getattr(model, name))
        parameters.step = period / steps
        for name, lag in (("thrust_response", model.thrust_lag), ("rate_response", model.rate_lag)):
            setattr(parameters, name, 1.0 - math.exp(-parameters.step / lag) if lag > 0.0 else 1.0)
        parameters.latency = round(model.latency / parameters.step)
        parameters.gust_keep = math.exp(-parameters.step / model.gust_time)
        self._parameters = parameters
        count = len(positions)
        hover = wp.vec4(model.mass * model.gravity, 0.0, 0.0, 0.0)
        known = 1 + math.ceil(parameters.latency / steps)
        attitudes = [(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)) for yaw in headings]
        with wp.ScopedDevice(device):
            self.position = wp.array(positions, dtype=wp.vec3)
            self.velocity = wp.zeros(count, dtype=wp.vec3)
            self.quaternion = wp.array(attitudes, dtype=wp.vec4)
            self.acceleration = wp.zeros(count, dtype=wp.vec3)
            self.control = wp.full(count, hover, dtype=wp.vec4)
            self.recent = wp.full((count, known), hover, dtype=wp.vec4)
            self.wind = wp.zeros(count, dtype=wp.vec3)
            self._seeds = wp.array([seed & 0x7FFFFFFF for seed in seeds or [0] * count], dtype=int)
            self.position_before = wp.clone(self.position)
            self.quaternion_before = wp.clone(self.quaternion)
            self.trail = wp.clone(wp.array([[p] * steps for p in positions], dtype=wp.vec3))

    def fly(self, commands: wp.array, *, finished: wp.array, phase: float = 0.0, tick: int = 0) -> None:
        """Hold one command of a sequence, F_t [N] and omega [rad/s], vec4 [B, any], for one period.

        Args:
            commands: sequences; the command at `phase` is held.
            finished: int [B]; vehicles with anything but 0 stand still.
            phase: place in the sequence, 0 for the first; between two, controls are interpolated linearly.
            tick: number of periods flown; picks the gusts.
        """
        state = [self.position, self.velocity, self.quaternion, self.acceleration, self.control]
        outputs = [*state, self.recent, self.wind, self.position_before, self.quaternion_before, self.trail]
        inputs = [self._parameters, commands, phase, tick, self._seeds, finished]
        wp.launch(fly_kernel, len(self.position), inputs, outputs, device=self.position.device)
