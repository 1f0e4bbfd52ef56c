"""Quadrotor and costs, one function per equation; see `aero_planner.kernels.costs`.

Quaternions are wp.vec4, w x y z, body to world.
"""

from __future__ import annotations

import warp as wp

from aero_planner.device.params import Params

wp.set_module_options({"enable_backward": False})

PROBES = wp.constant(10)
"""Positions on the path from the final state to the goal that the cost-to-go checks."""


@wp.func
def multiply(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Return a (x) b."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def rotation(q: wp.vec4) -> wp.mat33:
    """Return R(q)."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def rotate(q: wp.vec4, x: wp.vec3) -> wp.vec3:
    """Return R(q) x by Rodrigues' formula."""
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, x)
    return x + q[0] * t + wp.cross(u, t)


@wp.func
def rotate_back(q: wp.vec4, x: wp.vec3) -> wp.vec3:
    """Return R(q)^T x."""
    return rotate(wp.vec4(q[0], -q[1], -q[2], -q[3]), x)


@wp.func
def yaw(q: wp.vec4) -> float:
    """Return the yaw angle [rad]."""
    R = rotation(q)
    return wp.atan2(R[1, 0], R[0, 0])


@wp.func
def clamp_control(u: wp.vec4, c: Params) -> wp.vec4:
    """Return u clamped to the limits of the vehicle."""
    return wp.vec4(
        wp.clamp(u[0], c.thrust_min, c.thrust_max),
        wp.clamp(u[1], -c.rate_xy_max, c.rate_xy_max),
        wp.clamp(u[2], -c.rate_xy_max, c.rate_xy_max),
        wp.clamp(u[3], -c.rate_z_max, c.rate_z_max),
    )


@wp.func
def q_rate(q: wp.vec4, u: wp.vec4) -> wp.vec4:
    """Return dq = 1/2 q (x) [0, omega]."""
    return 0.5 * multiply(q, wp.vec4(0.0, u[1], u[2], u[3]))


@wp.func
def v_rate(q: wp.vec4, u: wp.vec4, c: Params) -> wp.vec3:
    """Return dv = R(q) [0, 0, F_t] / m + g."""
    return rotation(q) * wp.vec3(0.0, 0.0, u[0] / c.mass) - wp.vec3(0.0, 0.0, c.gravity)


@wp.func
def rk4(p: wp.vec3, v: wp.vec3, q: wp.vec4, u: wp.vec4, c: Params):
    """Return p, v and the normalised q after one Runge-Kutta step of dt at constant u."""
    h = c.dt
    q1 = q_rate(q, u)
    v1 = v_rate(q, u, c)
    q2 = q_rate(q + 0.5 * h * q1, u)
    v2 = v_rate(q + 0.5 * h * q1, u, c)
    q3 = q_rate(q + 0.5 * h * q2, u)
    v3 = v_rate(q + 0.5 * h * q2, u, c)
    q4 = q_rate(q + h * q3, u)
    v4 = v_rate(q + h * q3, u, c)
    p1 = v
    p2 = v + 0.5 * h * v1
    p3 = v + 0.5 * h * v2
    p4 = v + h * v3
    return (
        p + h / 6.0 * (p1 + 2.0 * p2 + 2.0 * p3 + p4),
        v + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4),
        wp.normalize(q + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)),
    )


@wp.func
def remaining(lag: float, time: float) -> float:
    """Return the share of a difference to the command that remains after `time`."""
    if lag > 0.0:
        return wp.exp(-time / lag)
    return 0.0


@wp.func
def follow_command(control: wp.vec4, command: wp.vec4, time: float, c: Params):
    """Return the mean control over `time` and the control at its end, if each component lags behind the command."""
    lags = wp.vec4(c.thrust_lag, c.rate_xy_lag, c.rate_xy_lag, c.rate_z_lag)
    mean = wp.vec4(0.0, 0.0, 0.0, 0.0)
    last = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for i in range(4):
        difference = control[i] - command[i]
        left = remaining(lags[i], time)
        last[i] = command[i] + left * difference
        mean[i] = command[i]
        if time > 0.0:
            mean[i] = command[i] + lags[i] * (1.0 - left) / time * difference
    return mean, last


@wp.func
def attitude_cost(q: wp.vec4, q_goal: wp.vec4) -> float:
    """Return |R(q) R(q_goal)^T - I|_F."""
    E = rotation(q) * wp.transpose(rotation(q_goal)) - wp.identity(n=3, dtype=float)
    return wp.sqrt(wp.ddot(E, E))


@wp.func
def goal_cost(
    p: wp.vec3, v: wp.vec3, q: wp.vec4, p_goal: wp.vec3, v_goal: wp.vec3, q_goal: wp.vec4, c: Params
) -> float:
    """Return J_goal of one time step."""
    return (
        c.q_position * wp.length(p - p_goal)
        + c.q_velocity * wp.length(v - v_goal)
        + c.q_attitude * attitude_cost(q, q_goal)
    )


@wp.func
def speed_cost(v: wp.vec3, c: Params) -> float:
    """Return the cost of speed and of a rate of descent above their limits, of one time step."""
    excess = wp.max(0.0, wp.length(v) - c.speed_limit)
    descent = wp.max(0.0, -v[2] - c.descent_limit)
    return c.q_speed * (excess * excess + descent * descent)


@wp.func
def jump_cost(u: wp.vec4, command: wp.vec4, c: Params) -> float:
    """Return the cost of the jump of the body rates from the command in force to the first one of a plan."""
    cost = float(0.0)
    for i in range(1, 4):
        cost += c.q_control_jump * (u[i] - command[i]) * (u[i] - command[i])
    return cost


@wp.func
def collision_cost(d: float, c: Params) -> float:
    """Return J_col of one time step at clearance d."""
    if d >= c.distance_max:
        return float(0.0)
    if c.shape == 1:  # exponential
        if d < c.distance_min:
            return c.penalty
        return c.penalty * wp.exp(-c.decay * (d - c.distance_min))
    if d < c.distance_min:
        return c.penalty * (2.0 - d / c.distance_min)
    s = (c.distance_max - d) / (c.distance_max - c.distance_min)
    return c.soft_weight * wp.min(1.0, c.speed_limit / c.soft_speed) * s * s


@wp.func
def path_length(p: wp.vec3, waypoint: wp.vec3, goal: wp.vec3, c: Params) -> float:
    """Return the length of the path from p by the waypoint to the goal, at most blocked_range [m]."""
    return wp.min(c.blocked_range, wp.length(waypoint - p) + wp.length(goal - waypoint))


@wp.func
def probe_position(p: wp.vec3, waypoint: wp.vec3, goal: wp.vec3, j: int, c: Params) -> wp.vec3:
    """Return the centre of segment j of the path from p by the waypoint to the goal."""
    s = (float(j) + 0.5) / float(PROBES) * path_length(p, waypoint, goal, c)
    first = wp.length(waypoint - p)
    if s <= first:
        return p + s / wp.max(first, 1.0e-6) * (waypoint - p)
    return waypoint + (s - first) / wp.max(wp.length(goal - waypoint), 1.0e-6) * (goal - waypoint)


@wp.func
def blocked_cost(p: wp.vec3, waypoint: wp.vec3, goal: wp.vec3, blocked: int, c: Params) -> float:
    """Return the cost of the blocked length of the path from p to the goal."""
    return c.q_blocked * path_length(p, waypoint, goal, c) * float(blocked) / float(PROBES)
