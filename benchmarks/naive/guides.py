"""Quintic guides and the nominal controls of every candidate."""

from __future__ import annotations

import warp as wp

from benchmarks.naive.arrays import Arrays
from benchmarks.naive.model import clamp_control, follow_command, remaining, rk4, rotate_back, rotation, yaw

wp.set_module_options({"enable_backward": False})


@wp.func
def power(t: float, n: int) -> float:
    """Return t^n."""
    product = float(1.0)
    for _ in range(n):
        product *= t
    return product


@wp.func
def write_guide(a: Arrays, b: int, m: int, p1: wp.vec3, v1: wp.vec3, dt: float):
    """Write the quintic from the drone's state to (p1, v1, 0) on [0, T], and its samples."""
    p0 = a.position[b]
    v0 = a.velocity[b]
    a0 = a.acceleration[b]
    if wp.isnan(a0[0]):
        a0 = wp.vec3(0.0, 0.0, 0.0)
    steps = a.nominal.shape[2]
    T = float(steps) * dt
    dp = p1 - p0 - T * v0 - 0.5 * T * T * a0
    dv = T * (v1 - v0 - T * a0)
    da = -0.5 * T * T * a0
    a.coefficient[b, m, 0] = p0
    a.coefficient[b, m, 1] = v0
    a.coefficient[b, m, 2] = 0.5 * a0
    a.coefficient[b, m, 3] = (10.0 * dp - 4.0 * dv + da) / power(T, 3)
    a.coefficient[b, m, 4] = (-15.0 * dp + 7.0 * dv - 2.0 * da) / power(T, 4)
    a.coefficient[b, m, 5] = (6.0 * dp - 3.0 * dv + da) / power(T, 5)
    for t in range(steps + 1):
        x = wp.vec3(0.0, 0.0, 0.0)
        for n in range(6):
            x += power(float(t) * dt, n) * a.coefficient[b, m, n]
        a.guide[b, m, t] = x


@wp.func
def acceleration_at(a: Arrays, b: int, m: int, s: float) -> wp.vec3:
    """Return the acceleration of a guide at time s."""
    x = wp.vec3(0.0, 0.0, 0.0)
    for n in range(2, 6):
        x += float(n * (n - 1)) * power(s, n - 2) * a.coefficient[b, m, n]
    return x


@wp.func
def follow_guide(a: Arrays, b: int, m: int, heading: float, lag: float, nominal: wp.array3d(dtype=wp.vec4)):
    """Write thrust and rates that follow a guide by differential flatness and turn evenly to `heading`.

    The rates approach what the guide requires with a time constant `lag`, from the command in force.
    """
    c = a.params[b]
    q0 = a.q0[b]
    steps = nominal.shape[2]
    difference = heading - yaw(q0)
    difference -= 2.0 * wp.PI * wp.floor(difference / (2.0 * wp.PI) + 0.5)
    yaw_rate = difference / (float(steps) * c.dt)
    lead = 2.0 * c.rate_xy_lag + lag
    before = a.command[b]
    control = a.control[b]
    q = q0
    for t in range(steps):
        u = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        if c.nominal == 0:
            up = wp.vec3(0.0, 0.0, c.gravity)
            force = c.mass * (acceleration_at(a, b, m, (float(t) + 0.5) * c.dt) + up)
            later = wp.min(float(t + 1) * c.dt + lead, float(steps) * c.dt)
            axis = wp.normalize(acceleration_at(a, b, m, later) + up)
            z = rotate_back(q, axis)
            sine = wp.sqrt(z[0] * z[0] + z[1] * z[1])
            rate = wp.atan2(sine, z[2]) / (wp.max(sine, 1.0e-6) * (c.dt + lead))
            u = wp.vec4(wp.dot(force, rotation(q) * wp.vec3(0.0, 0.0, 1.0)), -rate * z[1], rate * z[0], yaw_rate)
        u = clamp_control(u, c)
        for i in range(1, 4):
            u[i] += remaining(lag, c.dt) * (before[i] - u[i])
        before = u
        nominal[b, m, t] = u
        mean, control = follow_command(control, u, c.dt, c)
        _p, _v, q = rk4(wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0), q, mean, c)


@wp.func
def turned(v: wp.vec3, angle: float) -> wp.vec3:
    """Return v turned about the vertical axis."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec3(c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@wp.kernel
def guides(a: Arrays):
    """Write the guide and the waypoint of every candidate. Launched over [B, M]."""
    b, m = wp.tid()
    c = a.params[b]
    p0 = a.position[b]
    T = float(a.nominal.shape[2]) * c.dt
    to_goal = a.goal_position[b] - p0
    v1 = wp.vec3(0.0, 0.0, 0.0)
    a.waypoint[b, m] = a.goal_position[b]
    if m < a.direction.shape[1]:
        v1 = c.arrival_speed * wp.normalize(a.anchor[b, m] - p0)
        if a.reach[b] >= wp.length(to_goal):
            v1 = a.v_goal[b]
        elif a.reach[b] < c.waypoint_distance and c.waypoint_distance < wp.length(to_goal):
            a.waypoint[b, m] = p0 + c.waypoint_distance * wp.normalize(a.anchor[b, m] - p0)
    if m == a.previous_index:
        passed = float(a.time[b] - a.previous_time[b])
        if wp.isnan(a.time[b]) and not wp.isnan(a.previous_time[b]):
            passed = c.replan_period
        a.anchor[b, m] = a.previous_end[b]
        if not (passed >= 0.0 and passed < T):
            passed = float(-1.0)
            a.anchor[b, m] = p0 + a.reach[b] / wp.max(wp.length(to_goal), 1.0e-6) * to_goal
        elif wp.length(a.previous_waypoint[b] - p0) > a.reach[b]:
            a.waypoint[b, m] = a.previous_waypoint[b]
        a.elapsed[b] = passed
    if m == a.brake_index:
        a.anchor[b, m] = p0 + c.brake_reach * T * a.velocity[b]
    write_guide(a, b, m, a.anchor[b, m], v1, c.dt)


@wp.kernel
def nominal_controls(a: Arrays):
    """Write the nominal controls of every candidate. Launched over [B, M]."""
    b, m = wp.tid()
    c = a.params[b]
    steps = a.nominal.shape[2]
    if m == a.previous_index and a.elapsed[b] >= 0.0:
        hover = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        for t in range(steps):
            s = float(t) + a.elapsed[b] / c.dt
            i = int(s)
            before = hover
            after = hover
            if i < steps:
                before = a.previous_controls[b, i]
            if i + 1 < steps:
                after = a.previous_controls[b, i + 1]
            a.nominal[b, m, t] = before + (s - float(i)) * (after - before)
        return
    heading = yaw(a.q_goal[b])
    if m == a.brake_index:
        heading = yaw(a.q0[b])
    lag = c.nominal_lag
    if m == a.brake_index or m == a.previous_index:
        lag = 0.0
    follow_guide(a, b, m, heading, lag, a.nominal)
