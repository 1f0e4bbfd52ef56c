"""Quintic guides to the anchors, and the nominal controls that follow them by differential flatness."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.anchors import lookahead
from aero_planner.reference.dynamics import State, clamp_control, rk4, rotation
from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})


@wp.func
def fit_quintic(p0: wp.vec3, v0: wp.vec3, a0: wp.vec3, p1: wp.vec3, v1: wp.vec3, T: float, a: wp.array(dtype=wp.vec3)):
    """Write a_0 .. a_5 of p(t) = sum a_n t^n with p, p', p'' = (p0, v0, a0) at 0 and (p1, v1, 0) at T.

    In closed form, from what is left at T of p, T p' and T^2 p'' / 2 without the first three coefficients.
    """
    dp = p1 - p0 - T * v0 - 0.5 * T * T * a0
    dv = T * (v1 - v0 - T * a0)
    da = -0.5 * T * T * a0
    a[0] = p0
    a[1] = v0
    a[2] = 0.5 * a0
    a[3] = (10.0 * dp - 4.0 * dv + da) / (T * T * T)
    a[4] = (-15.0 * dp + 7.0 * dv - 2.0 * da) / (T * T * T * T)
    a[5] = (6.0 * dp - 3.0 * dv + da) / (T * T * T * T * T)


@wp.func
def guide_position(a: wp.array(dtype=wp.vec3), t: float) -> wp.vec3:
    """Return p(t) = sum a_n t^n."""
    return a[0] + t * (a[1] + t * (a[2] + t * (a[3] + t * (a[4] + t * a[5]))))


@wp.func
def guide_force(a: wp.array(dtype=wp.vec3), t: float, c: Parameters) -> wp.vec3:
    """Return the thrust vector f(t) = m (p''(t) + [0, 0, g]) that a guide requires."""
    acceleration = 2.0 * a[2] + t * (6.0 * a[3] + t * (12.0 * a[4] + t * (20.0 * a[5])))
    return c.m * (acceleration + wp.vec3(0.0, 0.0, c.g))


@wp.func
def yaw(q: wp.vec4) -> float:
    """Return the yaw angle [rad]."""
    R = rotation(q)
    return wp.atan2(R[1, 0], R[0, 0])


@wp.func
def yaw_rate(q: wp.vec4, q_goal: wp.vec4, T: float) -> float:
    """Return (yaw(q_goal) - yaw(q)) / T, the shorter way round."""
    turn = yaw(q_goal) - yaw(q)
    return (turn - 2.0 * wp.PI * wp.floor(turn / (2.0 * wp.PI) + 0.5)) / T


@wp.func
def tilt_rate(q: wp.vec4, f: wp.vec3, c: Parameters) -> wp.vec2:
    """Return omega_xy that turn the body axis z to f / |f| within dt.

    With z = R(q)^T f / |f|, it is the angle between e_3 and z over dt, about e_3 x z = [-z_y, z_x, 0].
    """
    z = wp.transpose(rotation(q)) * wp.normalize(f)
    sine = wp.sqrt(z[0] * z[0] + z[1] * z[1])
    rate = wp.atan2(sine, z[2]) / (wp.max(sine, 1.0e-6) * c.dt)
    return wp.vec2(-rate * z[1], rate * z[0])


@wp.kernel
def make_guides(
    x0: State, a0: wp.vec3, goal: State, c: Parameters, anchors: wp.array(dtype=wp.vec3),
    coefficients: wp.array2d(dtype=wp.vec3), guides: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Write a_n of the guide to each anchor, and p(t) at 0, dt, .. T. Launched over [M].

    Guides end at rest, those that end at the goal with its velocity.
    """
    m = wp.tid()
    N = guides.shape[1] - 1
    v1 = wp.vec3(0.0, 0.0, 0.0)
    if wp.length(goal.p - x0.p) <= lookahead(x0.p, goal.p, c):
        v1 = goal.v
    fit_quintic(x0.p, x0.v, a0, anchors[m], v1, float(N) * c.dt, coefficients[m])
    for t in range(N + 1):
        guides[m, t] = guide_position(coefficients[m], float(t) * c.dt)


@wp.kernel
def nominal_controls(
    x0: State, goal: State, c: Parameters, coefficients: wp.array2d(dtype=wp.vec3), nominal: wp.array2d(dtype=wp.vec4)
):
    """Write the controls that follow each guide, from the attitude reached so far. Launched over [M].

    F_t = f((t + 1/2) dt) . R(q) e_3, and omega turns e_3 to the direction of f((t + 1) dt).
    """
    m = wp.tid()
    N = nominal.shape[1]
    omega_z = yaw_rate(x0.q, goal.q, float(N) * c.dt)
    x = x0
    for t in range(N):
        F_t = wp.dot(guide_force(coefficients[m], (float(t) + 0.5) * c.dt, c), rotation(x.q) * wp.vec3(0.0, 0.0, 1.0))
        omega_xy = tilt_rate(x.q, guide_force(coefficients[m], float(t + 1) * c.dt, c), c)
        u = clamp_control(wp.vec4(F_t, omega_xy[0], omega_xy[1], omega_z), c)
        nominal[m, t] = u
        x = rk4(x, u, c)
