"""Rotations: quaternions are wp.vec4 in the order w, x, y, z, body to world."""

from __future__ import annotations

import warp as wp

from aero_planner.device.warp_ops import near_quotient

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
def wrap_angle(angle: float) -> float:
    """Return the angle wrapped to [-pi, pi)."""
    return angle - 2.0 * wp.PI * wp.floor(angle / (2.0 * wp.PI) + 0.5)
