"""The simulated quadrotor: the planner's model at a finer step, with optional lags and drag."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner import PlannerConfig

__all__ = ["Vehicle", "VehicleModel"]

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class VehicleModel:
    """Parameters of the simulated vehicle; the defaults are the planner's own model, without lags and drag."""

    mass: float = 1.0
    """m [kg]."""
    gravity: float = 9.81
    """g [m/s^2]."""
    thrust_min: float = 0.3
    """Smallest total thrust [N]."""
    thrust_max: float = 16.35
    """Largest total thrust [N]."""
    rate_xy_max: float = 3.0
    """Largest roll and pitch rate [rad/s]."""
    rate_z_max: float = 2.0
    """Largest yaw rate [rad/s]."""
    thrust_lag: float = 0.0
    """Time constant of the thrust's first-order response [s]; 0 follows at once."""
    rate_lag: float = 0.0
    """Time constant of the body rates' first-order response [s]; 0 follows at once."""
    drag: float = 0.0
    """Linear drag k in dv = .. - k v [1/s]."""
    step: float = 0.005
    """Longest integration step [s]."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            zero_allowed = f.name not in ("mass", "step", "thrust_max")
            if not (math.isfinite(value) and (value > 0.0 or (zero_allowed and value == 0.0))):
                sign = "not negative" if zero_allowed else "positive"
                raise ValueError(f"{f.name} of the vehicle is {value!r}; it must be finite and {sign}.")
        if self.thrust_min > self.thrust_max:
            raise ValueError(
                f"thrust_min of the vehicle, {self.thrust_min:g} N, exceeds thrust_max, {self.thrust_max:g} N."
            )

    @classmethod
    def from_config(cls, config: PlannerConfig, **changes: float) -> VehicleModel:
        """Return the vehicle that the planner of `config` assumes, with `changes`."""
        shared = ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max")
        return cls(**{name: getattr(config.vehicle, name) for name in shared} | changes)


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
def acceleration_of(v: VehicleParameters, state: Motion, control: wp.vec4):
    gravity = wp.vec3(0.0, 0.0, v.gravity)
    return thrust_acceleration(state.quaternion, control, v.mass) - gravity - v.drag * state.velocity


@wp.func
def derivative(v: VehicleParameters, state: Motion, control: wp.vec4):
    """dp = v; dv = R(q) [0, 0, F_t] / m + g - k v; dq = 1/2 q (x) [0, omega]."""
    q = state.quaternion
    x = control[1]
    y = control[2]
    z = control[3]
    rate = Motion()
    rate.position = state.velocity
    rate.velocity = acceleration_of(v, state, control)
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
def runge_kutta(v: VehicleParameters, state: Motion, control: wp.vec4):
    """One RK4 step under constant controls; the quaternion is normalised."""
    h = v.step
    k1 = derivative(v, state, control)
    k2 = derivative(v, moved(state, k1, 0.5 * h), control)
    k3 = derivative(v, moved(state, k2, 0.5 * h), control)
    k4 = derivative(v, moved(state, k3, h), control)
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


@wp.kernel
def fly_kernel(
    v: VehicleParameters,
    commands: wp.array2d(dtype=wp.vec4),
    finished: wp.array(dtype=int),
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    accelerations: wp.array(dtype=wp.vec3),
    controls: wp.array(dtype=wp.vec4),
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
    command = clamped(v, commands[b, 0])
    response = wp.vec4(v.thrust_response, v.rate_response, v.rate_response, v.rate_response)
    control = controls[b]
    for s in range(trail.shape[1]):
        control = control + wp.cw_mul(response, command - control)
        state = runge_kutta(v, state, control)
        trail[b, s] = state.position
    positions[b] = state.position
    velocities[b] = state.velocity
    quaternions[b] = state.quaternion
    accelerations[b] = acceleration_of(v, state, control)
    controls[b] = control


class Vehicle:
    """B equal vehicles, at rest and hovering at first.

    Args:
        model: of the vehicles.
        positions: first positions [m], [B, 3], world frame.
        headings: first yaw angles [rad], [B].
        period: time over which a command is held [s].
        device: Warp device.

    Attributes:
        position, velocity, acceleration: vec3 [B], world frame, SI.
        quaternion: body to world, w, x, y, z, vec4 [B].
        control: thrust [N] and body rates [rad/s] in effect, vec4 [B].
        position_before, quaternion_before: pose before the last command.
        trail: positions after each integration step of the last command, vec3 [B, S].
    """

    def __init__(self, model: VehicleModel, positions: Any, headings: Any, *, period: float, device: Any) -> None:
        self.model = model
        steps = math.ceil(period / model.step - 1e-6)
        parameters = VehicleParameters()
        for name in ("mass", "gravity", "thrust_min", "thrust_max", "rate_xy_max", "rate_z_max", "drag"):
            setattr(parameters, name, getattr(model, name))
        parameters.step = period / steps
        for name, lag in (("thrust_response", model.thrust_lag), ("rate_response", model.rate_lag)):
            setattr(parameters, name, 1.0 - math.exp(-parameters.step / lag) if lag > 0.0 else 1.0)
        self._parameters = parameters
        count = len(positions)
        attitudes = [(math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)) for yaw in headings]
        with wp.ScopedDevice(device):
            self.position = wp.array(positions, dtype=wp.vec3)
            self.velocity = wp.zeros(count, dtype=wp.vec3)
            self.quaternion = wp.array(attitudes, dtype=wp.vec4)
            self.acceleration = wp.zeros(count, dtype=wp.vec3)
            self.control = wp.full(count, wp.vec4(model.mass * model.gravity, 0.0, 0.0, 0.0), dtype=wp.vec4)
            self.position_before = wp.clone(self.position)
            self.quaternion_before = wp.clone(self.quaternion)
            self.trail = wp.clone(wp.array([[p] * steps for p in positions], dtype=wp.vec3))

    def fly(self, commands: wp.array, *, finished: wp.array) -> None:
        """Hold `commands[:, 0]`, F_t [N] and omega [rad/s], vec4 [B, any], for one period.

        Vehicles with anything but 0 in `finished`, int [B], stand still.
        """
        state = [self.position, self.velocity, self.quaternion, self.acceleration, self.control]
        outputs = [*state, self.position_before, self.quaternion_before, self.trail]
        inputs = [self._parameters, commands, finished]
        wp.launch(fly_kernel, len(self.position), inputs, outputs, device=self.position.device)
