"""What flies in the simulation, by the vehicle model of the planner: how its commands become motion."""

# Postponed annotations are left out: Warp functions need the types themselves.

import functools
from dataclasses import dataclass

import warp as wp

from aero_planner import registry
from aero_planner.device.params import Params
from aero_planner.device.rotations import quat_inverse_rotate
from aero_viz.flight.motion import Motion, VehicleParameters, runge_kutta, total_acceleration

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Plant:
    """Functions of a simulated vehicle, each a `@wp.func`.

    v are the parameters of the simulated vehicle, c those of a configuration of the planner with its values. The
    control is what is in effect after the commands, four numbers that belong to the state.

    Args:
        clamp: (u, v, c) -> the command that the vehicle accepts.
        hover: (v, c) -> the command at which the vehicle at rest stays at rest.
        rest: (v, c) -> the control in effect then.
        step: (state, control, command, wind, v, c) -> state and control after an integration step.
        acceleration: (state, control, wind, v, c) -> acceleration [m/s^2], world frame.
    """

    clamp: wp.Function
    hover: wp.Function
    rest: wp.Function
    step: wp.Function
    acceleration: wp.Function


@functools.cache
def plant_of(model: str) -> Plant:
    """Return what flies as a vehicle model of the planner says.

    "ctbr": a quadrotor that follows thrust and body rates with lags. "acceleration": the same quadrotor with an
    autopilot. Any other model is its own plant: its step, with a finer time step.
    """
    shipped = {"ctbr": QUADROTOR, "acceleration": AUTOPILOT}
    return shipped[model] if model in shipped else _own_plant(model)


@wp.func
def clamp_control(u: wp.vec4, v: VehicleParameters, c: Params) -> wp.vec4:
    """Return thrust and body rates within the bounds of the quadrotor."""
    return wp.vec4(
        wp.clamp(u[0], v.thrust_min, v.thrust_max),
        wp.clamp(u[1], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(u[2], -v.rate_xy_max, v.rate_xy_max),
        wp.clamp(u[3], -v.rate_z_max, v.rate_z_max),
    )


@wp.func
def hover_control(v: VehicleParameters, c: Params) -> wp.vec4:
    """Return the thrust m g, without rotation."""
    return wp.vec4(v.mass * v.gravity, 0.0, 0.0, 0.0)


@wp.func
def follow_control(
    state: Motion, control: wp.vec4, command: wp.vec4, wind: wp.vec3, v: VehicleParameters, c: Params
):  # fmt: skip
    """Follow thrust and body rates, each with a first-order lag."""
    response = wp.vec4(v.thrust_response, v.rate_response, v.rate_response, v.rate_response)
    after = control + wp.cw_mul(response, command - control)
    return runge_kutta(v, state, after, wind), after


@wp.func
def quadrotor_acceleration(
    state: Motion, control: wp.vec4, wind: wp.vec3, v: VehicleParameters, c: Params
) -> wp.vec3:  # fmt: skip
    """Return the acceleration of the quadrotor."""
    return total_acceleration(state, control, wind, v)


@wp.func
def any_setpoint(u: wp.vec4, v: VehicleParameters, c: Params) -> wp.vec4:
    """Return u: the autopilot bounds what it makes of a setpoint."""
    return u


@wp.func
def no_acceleration(v: VehicleParameters, c: Params) -> wp.vec4:
    """Return the setpoint of no acceleration."""
    return wp.vec4(0.0, 0.0, 0.0, 0.0)


@wp.func
def attitude_control(q: wp.vec4, setpoint: wp.vec4, v: VehicleParameters) -> wp.vec4:
    """Return thrust and body rates for a setpoint of the acceleration and the yaw rate.

    As in PX4, the thrust per mass is f = a - g, for the attitude that is asked for; the rates are proportional to the
    error of the tilt, twice the vector part of its quaternion, and the yaw rate is about the vertical.
    """
    f = wp.vec3(setpoint[0], setpoint[1], setpoint[2] + v.gravity)
    thrust = wp.length(f)
    up = quat_inverse_rotate(q, wp.vec3(0.0, 0.0, 1.0))
    z = up
    if thrust > 0.0:
        z = quat_inverse_rotate(q, f / thrust)
    # The shortest rotation to z is about e_3 x z by an angle t; the vector part of its quaternion has length sin(t/2).
    gain = v.attitude_gain * wp.sqrt(2.0 / wp.max(1.0 + z[2], 1.0e-6))
    turn = setpoint[3]
    return wp.vec4(v.mass * thrust, turn * up[0] - gain * z[1], turn * up[1] + gain * z[0], turn * up[2])


@wp.func
def follow_setpoint(
    state: Motion, control: wp.vec4, command: wp.vec4, wind: wp.vec3, v: VehicleParameters, c: Params
):  # fmt: skip
    """Follow acceleration and yaw rate through the attitude control, and that through the lags of the quadrotor."""
    wanted = clamp_control(attitude_control(state.quaternion, command, v), v, c)
    return follow_control(state, control, wanted, wind, v, c)


QUADROTOR = Plant(clamp_control, hover_control, hover_control, follow_control, quadrotor_acceleration)
"""A quadrotor that follows thrust [N] and body rates [rad/s]."""
AUTOPILOT = Plant(any_setpoint, no_acceleration, hover_control, follow_setpoint, quadrotor_acceleration)
"""The same quadrotor with an autopilot that takes an acceleration [m/s^2] and a yaw rate [rad/s]."""


def _own_plant(name: str) -> Plant:
    """Return the plant that moves as a vehicle model of the planner says, with the drag and wind of the simulation."""
    model = registry.load("models", name)
    clamp_of, hover_of, constants = model.clamp, model.hover, model.constants
    step_of, acceleration_of = model.step, model.acceleration

    @wp.func
    def clamp(u: wp.vec4, v: VehicleParameters, c: Params) -> wp.vec4:
        return clamp_of(u, c)

    @wp.func
    def hover(v: VehicleParameters, c: Params) -> wp.vec4:
        return hover_of(c)

    @wp.func
    def step(
        state: Motion, control: wp.vec4, command: wp.vec4, wind: wp.vec3, v: VehicleParameters, c: Params
    ):  # fmt: skip
        k = constants(v.drag * wind, v.drag, v.step, c)
        position, velocity, quaternion, after = step_of(
            state.position, state.velocity, state.quaternion, control, command, k
        )
        moved = Motion()
        moved.position = position
        moved.velocity = velocity
        moved.quaternion = quaternion
        return moved, after

    @wp.func
    def acceleration(
        state: Motion, control: wp.vec4, wind: wp.vec3, v: VehicleParameters, c: Params
    ) -> wp.vec3:  # fmt: skip
        k = constants(v.drag * wind, v.drag, v.step, c)
        return acceleration_of(state.velocity, state.quaternion, control, k)

    return Plant(clamp, hover, hover, step, acceleration)
