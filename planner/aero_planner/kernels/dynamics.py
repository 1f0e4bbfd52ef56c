"""Quadrotor model and its Runge-Kutta step.

State x = [p, q, v], control u = (F_t, omega): dp = v, dq = 1/2 q (x) [0, omega],
dv = R(q) [0, 0, F_t] / m + g + d - k v. Disturbance d and drag k are estimated in flight; they are 0 in the paper.
With lags tau, u is the control in effect and follows the commands c: du = (c - u) / tau, for each component.
Quaternions are wp.vec4 in the order w, x, y, z, body to world.
"""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params
from aero_planner.kernels.warp_ops import near_quotient

wp.set_module_options({"enable_backward": False})


@wp.func
def atan_unit(x: float) -> float:
    """Return atan(x) for |x| <= 1, to 1e-7 rad, by a minimax polynomial that a CPU can vectorise."""
    z = x * x
    f = -0.00405456246
    f = f * z + 0.0218629402
    f = f * z - 0.0559123006
    f = f * z + 0.0964219536
    f = f * z - 0.139086288
    f = f * z + 0.199465655
    f = f * z - 0.333298608
    f = f * z + 0.999999336
    return x * f


@wp.func
def near_atan2(y: float, x: float) -> float:
    """Return atan2(y, x) to 3e-7 rad, without a branch."""
    a = wp.abs(y)
    b = wp.abs(x)
    angle = 0.25 * wp.PI + atan_unit(near_quotient(a - b, a + b + 1.0e-30))
    angle = wp.where(x < 0.0, wp.PI - angle, angle)
    return wp.where(y < 0.0, -angle, angle)


@wp.func
def quat_multiply(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Return the Hamilton product a (x) b."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_rotate(q: wp.vec4, x: wp.vec3) -> wp.vec3:
    """Return R(q) x: x from the body to the world frame."""
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, x)
    return x + q[0] * t + wp.cross(u, t)


@wp.func
def quat_inverse_rotate(q: wp.vec4, x: wp.vec3) -> wp.vec3:
    """Return R(q)^T x: x from the world to the body frame."""
    u = wp.vec3(-q[1], -q[2], -q[3])
    t = 2.0 * wp.cross(u, x)
    return x + q[0] * t + wp.cross(u, t)


@wp.func
def quat_from_heading(heading: float) -> wp.vec4:
    """Return the level attitude with yaw `heading` [rad]."""
    return wp.vec4(wp.cos(0.5 * heading), 0.0, 0.0, wp.sin(0.5 * heading))


@wp.func
def heading(q: wp.vec4) -> float:
    """Return the yaw of an attitude [rad]."""
    return wp.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


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
def clamp_control(u: wp.vec4, params: Params) -> wp.vec4:
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
def lag_share(lag: float, time: float) -> float:
    """Return the share of a difference to the command that remains after `time`; 0 without a lag."""
    return wp.where(lag > 0.0, wp.exp(-time / wp.max(lag, 1.0e-6)), 0.0)


@wp.func
def lag_shares(time: float, params: Params) -> wp.vec4:
    """Return the shares of the differences between commands and controls that remain after `time` [s]."""
    xy = lag_share(params.rate_xy_lag, time)
    return wp.vec4(lag_share(params.thrust_lag, time), xy, xy, lag_share(params.rate_z_lag, time))


@wp.func
def mean_lag_shares(remaining: wp.vec4, time: float, params: Params) -> wp.vec4:
    """Return the means of these shares over `time` [s], at the end of which they are `remaining`."""
    lags = wp.vec4(params.thrust_lag, params.rate_xy_lag, params.rate_xy_lag, params.rate_z_lag)
    return wp.cw_mul(lags, wp.vec4(1.0, 1.0, 1.0, 1.0) - remaining) / time


@wp.func
def lagged_control(command: wp.vec4, control: wp.vec4, shares: wp.vec4) -> wp.vec4:
    """Return the control in effect if the given shares of its difference to the command remain."""
    return command + wp.cw_mul(shares, control - command)


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
def rotate_by_rates(q: wp.vec4, omega: wp.vec3, dt: float) -> wp.vec4:
    """Return the unit quaternion after dt at constant body rates, the attitude part of `rk4_step`."""
    factors = _step_factors(q, 0.25 * dt * dt * wp.dot(omega, omega))
    return factors[0] * q + factors[1] * _half_turn(q, omega, dt)


@wp.func
def thrust_free_acceleration(disturbance: wp.vec3, params: Params) -> wp.vec3:
    """Return g + d, the acceleration without thrust and drag [m/s^2], world frame."""
    return disturbance - wp.vec3(0.0, 0.0, params.gravity)


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
