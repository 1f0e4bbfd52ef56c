"""The paper's model: collective thrust and body rates (CTBR).

State x = [p, q, v], control u = (F_t, omega): dp = v, dq = 1/2 q (x) [0, omega],
dv = R(q) [0, 0, F_t] / m + g + d - k v. Disturbance d and drag k are estimated in flight; they are 0 in the paper.
With lags tau, u is the control in effect and follows the commands c: du = (c - u) / tau, for each component.
"""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.device.lag import lag_share
from aero_planner.device.quintics import Quintic, force_at, guide_force
from aero_planner.device.rotations import near_atan2, quat_inverse_rotate, quat_multiply
from aero_planner.models.vehicle_model import VehicleModel

wp.set_module_options({"enable_backward": False})


@wp.struct
class Constants:
    """What is constant over all steps of a rollout."""

    dt: float  # [s]
    mass: float  # [kg]
    g: wp.vec3  # g + d, the acceleration without thrust and drag, world frame [m/s^2]
    drag: float  # k [1/s]
    shares: wp.vec4  # shares of the differences between commands and controls that remain after a step
    mean_shares: wp.vec4  # their means over the step


@wp.func
def clamp(u: wp.vec4, params: Any) -> wp.vec4:
    """Return u clamped to the limits of the vehicle."""
    xy = params.rate_xy_max
    z = params.rate_z_max
    return wp.vec4(
        wp.clamp(u[0], params.thrust_min, params.thrust_max),
        wp.clamp(u[1], -xy, xy),
        wp.clamp(u[2], -xy, xy),
        wp.clamp(u[3], -z, z),
    )


@wp.func
def lag_shares(time: float, params: Any) -> wp.vec4:
    """Return the shares of the differences between commands and controls that remain after `time` [s]."""
    rates = lag_share(params.rate_lag, time)
    return wp.vec4(lag_share(params.thrust_lag, time), rates, rates, rates)


@wp.func
def mean_lag_shares(remaining: wp.vec4, time: float, params: Any) -> wp.vec4:
    """Return the means of these shares over `time` [s], at the end of which they are `remaining`."""
    lags = wp.vec4(params.thrust_lag, params.rate_lag, params.rate_lag, params.rate_lag)
    return wp.cw_mul(lags, wp.vec4(1.0, 1.0, 1.0, 1.0) - remaining) / time


@wp.func
def lagged_control(command: wp.vec4, control: wp.vec4, shares: wp.vec4) -> wp.vec4:
    """Return the control in effect if the given shares of its difference to the command remain."""
    return command + wp.cw_mul(shares, control - command)


@wp.func
def _axis_change(q: wp.vec4) -> wp.vec3:
    """Return Q(q) = R(q) e_3 - e_3, a quadratic form."""
    return wp.vec3(
        2.0 * (q[1] * q[3] + q[0] * q[2]), 2.0 * (q[2] * q[3] - q[0] * q[1]), -2.0 * (q[1] * q[1] + q[2] * q[2])
    )


@wp.func
def thrust_axis(q: wp.vec4) -> wp.vec3:
    """Return R(q) e_3: the body z axis in the world frame."""
    change = _axis_change(q)
    return wp.vec3(change[0], change[1], 1.0 + change[2])


@wp.func
def _half_turn(q: wp.vec4, omega: wp.vec3, dt: float) -> wp.vec4:
    """Return h = dt/2 dq, the change of q in half a time step at its rate dq = 1/2 q (x) [0, omega]."""
    return quat_multiply(q, wp.vec4(0.0, 0.25 * dt * omega[0], 0.25 * dt * omega[1], 0.25 * dt * omega[2]))


@wp.func
def _step_factors(q: wp.vec4, s: float) -> wp.vec2:
    """Return the factors of q and h = `_half_turn` in the unit quaternion after a time step at constant body rates.

    dq = A q is linear in q with A^2 = -|omega|^2 / 4, so the four RK4 stages sum to a q + b h. As h is orthogonal to q,
    the norm |a q + b h| follows from s = |omega dt|^2 / 4 and |q|, and no square root depends on the new q. The
    deviation of |q| from 1 by rounding is corrected by the first terms of the series of 1 / |q|.
    """
    unit = 1.0 / wp.sqrt(1.0 - s * s * s * (1.0 / 72.0) + s * s * s * s * (1.0 / 576.0))
    unit = unit * (1.5 - 0.5 * wp.dot(q, q))
    return wp.vec2(unit * (1.0 - s * (1.0 / 2.0) + s * s * (1.0 / 24.0)), unit * (2.0 - s * (1.0 / 3.0)))


@wp.func
def _mixed_axis_change(a: wp.vec4, b: wp.vec4) -> wp.vec3:
    """Return Q(a + b) - Q(a) - Q(b), with Q = `_axis_change`."""
    return wp.vec3(
        2.0 * (a[1] * b[3] + a[3] * b[1] + a[0] * b[2] + a[2] * b[0]),
        2.0 * (a[2] * b[3] + a[3] * b[2] - a[0] * b[1] - a[1] * b[0]),
        -4.0 * (a[1] * b[1] + a[2] * b[2]),
    )


@wp.func
def rk4_step(p: wp.vec3, v: wp.vec3, q: wp.vec4, u: wp.vec4, mass: float, g: wp.vec3, drag: float, dt: float):
    """Return p, v and q, renormalised, after one RK4 step at constant control from a unit q.

    The velocity follows dv/dt = F_t / m z + g - drag v, with the body axis z and the acceleration g without thrust and
    drag [m/s^2].
    """
    omega = wp.vec3(u[1], u[2], u[3])
    thrust = u[0] / mass
    s = 0.25 * dt * dt * wp.dot(omega, omega)
    h = _half_turn(q, omega, dt)
    # By the algebra of `_step_factors`, the stages of the attitude are q, q + h, alpha q + h and beta q + 2 alpha h.
    # Their axes are e_3 + Q, where Q(a q + b h) = a^2 Q(q) + a b Q(q, h) + b^2 Q(h), so that sums of the stages need
    # these three terms only.
    alpha = 1.0 - 0.25 * s
    beta = 1.0 - 0.5 * s
    Q_q = _axis_change(q)
    Q_h = _axis_change(h)
    Q_qh = _mixed_axis_change(q, h)
    # With A = F_t / m z + g - drag v and k = drag dt/2, the stages of dv are a_1 = A_1, a_2 = A_2 - k a_1,
    # a_3 = A_3 - k a_2 and a_4 = A_4 - 2 k a_3. The sums are a_1 + 2 a_2 + 2 a_3 + a_4 = c_1 A_1 + .. + c_3 A_3 + A_4,
    # and, as dp = v, a_1 + a_2 + a_3 = d_1 A_1 + d_2 A_2 + A_3.
    k = 0.5 * dt * drag
    c3 = 2.0 - 2.0 * k
    c2 = 2.0 - k * c3
    c1 = 1.0 - k * c2
    d2 = 1.0 - k
    d1 = 1.0 - k * d2
    level = g - drag * v + wp.vec3(0.0, 0.0, thrust)
    sum_v = (c1 + c2 + c3 + 1.0) * level + thrust * (
        (c1 + c2 + c3 * alpha * alpha + beta * beta) * Q_q
        + (c2 + c3 * alpha + 2.0 * alpha * beta) * Q_qh
        + (c2 + c3 + 4.0 * alpha * alpha) * Q_h
    )
    sum_p = (d1 + d2 + 1.0) * level + thrust * (
        (d1 + d2 + alpha * alpha) * Q_q + (d2 + alpha) * Q_qh + (d2 + 1.0) * Q_h
    )
    factors = _step_factors(q, s)
    p_next = p + dt * v + (dt * dt * (1.0 / 6.0)) * sum_p
    v_next = v + (dt * (1.0 / 6.0)) * sum_v
    return p_next, v_next, factors[0] * q + factors[1] * h


@wp.func
def hover(params: Any) -> wp.vec4:
    """Return the thrust m g, without rotation."""
    return wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)


@wp.func
def noise(params: Any) -> wp.vec4:
    """Return the standard deviations of F_t and omega."""
    xy = wp.sqrt(params.variance_rate_xy)
    return wp.vec4(wp.sqrt(params.variance_thrust), xy, xy, wp.sqrt(params.variance_rate_z))


@wp.func
def respond(u: wp.vec4, acting: wp.vec4, time: float, params: Any) -> wp.vec4:
    """Return the control in effect after u was commanded for a time [s]."""
    return lagged_control(u, acting, lag_shares(time, params))


@wp.func
def constants(disturbance: wp.vec3, drag: float, dt: float, params: Any) -> Constants:
    """Return the constants of steps of dt [s]."""
    k = Constants()
    k.dt = dt
    k.mass = params.mass
    k.g = disturbance - wp.vec3(0.0, 0.0, params.gravity)
    k.drag = drag
    k.shares = lag_shares(dt, params)
    k.mean_shares = mean_lag_shares(k.shares, dt, params)
    return k


@wp.func
def step(p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, u: wp.vec4, k: Constants):
    """Return p, v, q and the control in effect after a step at a constant command u, by RK4 at the mean control."""
    mean = lagged_control(u, acting, k.mean_shares)
    p, v, q = rk4_step(p, v, q, mean, k.mass, k.g, k.drag, k.dt)
    return p, v, q, lagged_control(u, acting, k.shares)


@wp.func
def acceleration(v: wp.vec3, q: wp.vec4, acting: wp.vec4, k: Constants) -> wp.vec3:
    """Return R(q) [0, 0, F_t] / m + g + d - k v."""
    return (acting[0] / k.mass) * thrust_axis(q) + k.g - k.drag * v


@wp.func
def follow(
    p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, guide: Quintic, time: float, yaw_rate: float, k: Constants,
    params: Any,
) -> wp.vec4:  # fmt: skip
    """Return the control that follows a guide: F_t and omega from the flat outputs position and heading.

    The guide determines the thrust vector m (a - g - d + k v) and with it the body z axis. The body rates turn the
    attitude to the required axis at the end of the time step, which also corrects an attitude that does not fit the
    guide.

    With a rate lag tau, the rates correct the attitude within dt + 2 tau instead of dt, which is the fastest correction
    that does not overshoot by more than 5 percent, and follow the axis that is required that much later.
    """
    required = guide_force(guide, k.g, k.drag)
    lead = k.dt + 2.0 * params.rate_lag
    f = force_at(required, wp.min(time + 0.5 * k.dt, guide.T))
    z_body = quat_inverse_rotate(q, wp.normalize(force_at(required, wp.min(time + lead, guide.T))))
    # The shortest rotation of the body z axis is about e_3 x z_body, by the angle between them.
    sine = wp.sqrt(z_body[0] * z_body[0] + z_body[1] * z_body[1])
    gain = near_atan2(sine, z_body[2]) / (wp.max(sine, 1.0e-6) * lead)
    return clamp(wp.vec4(k.mass * wp.dot(f, thrust_axis(q)), -gain * z_body[1], gain * z_body[0], yaw_rate), params)


CTBR = VehicleModel(
    name="ctbr",
    label="Thrust and body rates",
    controls=(("F_t", "N"), ("omega_x", "rad/s"), ("omega_y", "rad/s"), ("omega_z", "rad/s")),
    clamp=clamp,
    hover=hover,
    noise=noise,
    respond=respond,
    constants=constants,
    step=step,
    acceleration=acceleration,
    follow=follow,
)
