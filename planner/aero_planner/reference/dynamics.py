"""The quadrotor: state x = [p, q, v], control u = (F_t, omega), one Runge-Kutta step, and rollouts."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})


@wp.struct
class State:
    """State x of the drone, or its change."""

    p: wp.vec3  # position [m], world frame
    q: wp.vec4  # attitude, unit quaternion w x y z, body to world
    v: wp.vec3  # velocity [m/s], world frame


@wp.func
def product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Return the product of quaternions a (x) b."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def rotation(q: wp.vec4) -> wp.mat33:
    """Return R(q), the matrix that turns vectors of the body frame to the world frame."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def clamp_control(u: wp.vec4, c: Parameters) -> wp.vec4:
    """Return u within F_min <= F_t <= F_max, |omega_xy| <= omega_xy_max, |omega_z| <= omega_z_max."""
    return wp.vec4(
        wp.clamp(u[0], c.F_min, c.F_max),
        wp.clamp(u[1], -c.omega_xy_max, c.omega_xy_max),
        wp.clamp(u[2], -c.omega_xy_max, c.omega_xy_max),
        wp.clamp(u[3], -c.omega_z_max, c.omega_z_max),
    )


@wp.func
def derivative(x: State, u: wp.vec4, c: Parameters) -> State:
    """Return dx/dt: dp = v, dq = 1/2 q (x) [0, omega], dv = R(q) [0, 0, F_t] / m + [0, 0, -g]."""
    dx = State()
    dx.p = x.v
    dx.q = 0.5 * product(x.q, wp.vec4(0.0, u[1], u[2], u[3]))
    dx.v = rotation(x.q) * wp.vec3(0.0, 0.0, u[0] / c.m) - wp.vec3(0.0, 0.0, c.g)
    return dx


@wp.func
def moved(x: State, h: float, dx: State) -> State:
    """Return x + h dx."""
    y = State()
    y.p = x.p + h * dx.p
    y.q = x.q + h * dx.q
    y.v = x.v + h * dx.v
    return y


@wp.func
def rk4(x: State, u: wp.vec4, c: Parameters) -> State:
    """Return x + dt/6 (k1 + 2 k2 + 2 k3 + k4), with q renormalised."""
    k1 = derivative(x, u, c)
    k2 = derivative(moved(x, 0.5 * c.dt, k1), u, c)
    k3 = derivative(moved(x, 0.5 * c.dt, k2), u, c)
    k4 = derivative(moved(x, c.dt, k3), u, c)
    k = moved(moved(moved(k1, 2.0, k2), 2.0, k3), 1.0, k4)
    y = moved(x, c.dt / 6.0, k)
    y.q = wp.normalize(y.q)
    return y


@wp.kernel
def roll_out(x0: State, c: Parameters, controls: wp.array3d(dtype=wp.vec4), states: wp.array3d(dtype=State)):
    """Write x_0 .. x_N under the controls u_0 .. u_{N-1} of every sample. Launched over [M, K]."""
    m, k = wp.tid()
    states[m, k, 0] = x0
    for t in range(controls.shape[2]):
        states[m, k, t + 1] = rk4(states[m, k, t], controls[m, k, t], c)
