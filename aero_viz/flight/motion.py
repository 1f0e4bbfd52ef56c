"""The motion of the simulated quadrotor under given thrust and body rates, by Runge-Kutta integration."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class VehicleParameters:
    """`VehicleModel` for kernels. A response is the share of a change that happens within one step."""

    mass: float
    gravity: float
    thrust_min: float
    thrust_max: float
    rate_xy_max: float
    rate_z_max: float
    thrust_response: float
    rate_response: float
    attitude_gain: float
    drag: float
    step: float
    latency: int
    """Number of integration steps."""
    gust_decay: float
    """Share of the wind that remains after one step."""
    gust_speed: float


@wp.struct
class Motion:
    """Position [m], velocity [m/s] and quaternion (w, x, y, z, body to world) of a state, or their derivatives."""

    position: wp.vec3
    velocity: wp.vec3
    quaternion: wp.vec4


@wp.func
def thrust_axis(q: wp.vec4):
    """Return R(q) e_3, the body z axis in the world frame."""
    return wp.vec3(
        2.0 * (q[1] * q[3] + q[0] * q[2]),
        2.0 * (q[2] * q[3] - q[0] * q[1]),
        q[0] * q[0] - q[1] * q[1] - q[2] * q[2] + q[3] * q[3],
    )


@wp.func
def total_acceleration(state: Motion, control: wp.vec4, wind: wp.vec3, v: VehicleParameters):
    """dv = R(q) [0, 0, F_t] / m + g - k (v - w) [m/s^2]."""
    thrust = (control[0] / v.mass) * thrust_axis(state.quaternion)
    return thrust - wp.vec3(0.0, 0.0, v.gravity) - v.drag * (state.velocity - wind)


@wp.func
def derivative(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """dp = v; dv = R(q) [0, 0, F_t] / m + g - k (v - w); dq = 1/2 q (x) [0, omega]."""
    q = state.quaternion
    x = control[1]
    y = control[2]
    z = control[3]
    rate = Motion()
    rate.position = state.velocity
    rate.velocity = total_acceleration(state, control, wind, v)
    rate.quaternion = 0.5 * wp.vec4(
        -q[1] * x - q[2] * y - q[3] * z,
        q[0] * x + q[2] * z - q[3] * y,
        q[0] * y + q[3] * x - q[1] * z,
        q[0] * z + q[1] * y - q[2] * x,
    )
    return rate


@wp.func
def extrapolate(state: Motion, rate: Motion, time: float):
    """Return state + time * rate."""
    result = Motion()
    result.position = state.position + time * rate.position
    result.velocity = state.velocity + time * rate.velocity
    result.quaternion = state.quaternion + time * rate.quaternion
    return result


@wp.func
def runge_kutta(v: VehicleParameters, state: Motion, control: wp.vec4, wind: wp.vec3):
    """Integrate one RK4 step under constant controls and wind, and normalise the quaternion."""
    h = v.step
    k1 = derivative(v, state, control, wind)
    k2 = derivative(v, extrapolate(state, k1, 0.5 * h), control, wind)
    k3 = derivative(v, extrapolate(state, k2, 0.5 * h), control, wind)
    k4 = derivative(v, extrapolate(state, k3, h), control, wind)
    mean = Motion()
    mean.position = (k1.position + 2.0 * k2.position + 2.0 * k3.position + k4.position) / 6.0
    mean.velocity = (k1.velocity + 2.0 * k2.velocity + 2.0 * k3.velocity + k4.velocity) / 6.0
    mean.quaternion = (k1.quaternion + 2.0 * k2.quaternion + 2.0 * k3.quaternion + k4.quaternion) / 6.0
    result = extrapolate(state, mean, h)
    result.quaternion = wp.normalize(result.quaternion)
    return result
