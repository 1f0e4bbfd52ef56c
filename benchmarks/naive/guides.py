"""Quintic guides and the nominal controls of every candidate."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params
from benchmarks.naive.model import clamp_control, rk4, rotate_back, rotation, yaw

__all__ = ["BRAKING_CANDIDATES", "guides", "nominal_controls", "write_brake"]

wp.set_module_options({"enable_backward": False})


@wp.func
def power(t: float, n: int) -> float:
    """Return t^n."""
    product = float(1.0)
    for _ in range(n):
        product *= t
    return product


@wp.func
def write_guide(
    b: int, m: int, p0: wp.vec3, v0: wp.vec3, a0: wp.vec3, p1: wp.vec3, v1: wp.vec3, dt: float,
    coefficient: wp.array3d(dtype=wp.vec3), guide: wp.array3d(dtype=wp.vec3),
):  # fmt: skip
    """Write the quintic from (p0, v0, a0) to (p1, v1, 0) on [0, T], and its samples."""
    steps = guide.shape[2] - 1
    T = float(steps) * dt
    dp = p1 - p0 - T * v0 - 0.5 * T * T * a0
    dv = T * (v1 - v0 - T * a0)
    da = -0.5 * T * T * a0
    coefficient[b, m, 0] = p0
    coefficient[b, m, 1] = v0
    coefficient[b, m, 2] = 0.5 * a0
    coefficient[b, m, 3] = (10.0 * dp - 4.0 * dv + da) / power(T, 3)
    coefficient[b, m, 4] = (-15.0 * dp + 7.0 * dv - 2.0 * da) / power(T, 4)
    coefficient[b, m, 5] = (6.0 * dp - 3.0 * dv + da) / power(T, 5)
    for t in range(steps + 1):
        x = wp.vec3(0.0, 0.0, 0.0)
        for n in range(6):
            x += power(float(t) * dt, n) * coefficient[b, m, n]
        guide[b, m, t] = x


@wp.func
def acceleration_at(b: int, m: int, s: float, coefficient: wp.array3d(dtype=wp.vec3)) -> wp.vec3:
    """Return the acceleration of a guide at time s."""
    a = wp.vec3(0.0, 0.0, 0.0)
    for n in range(2, 6):
        a += float(n * (n - 1)) * power(s, n - 2) * coefficient[b, m, n]
    return a


@wp.func
def follow_guide(
    b: int, m: int, q0: wp.vec4, heading: float, c: Params, coefficient: wp.array3d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
):  # fmt: skip
    """Write thrust and rates that follow a guide by differential flatness and turn evenly to `heading`."""
    steps = nominal.shape[2]
    difference = heading - yaw(q0)
    difference -= 2.0 * wp.PI * wp.floor(difference / (2.0 * wp.PI) + 0.5)
    yaw_rate = difference / (float(steps) * c.dt)
    q = q0
    for t in range(steps):
        u = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        if c.nominal == 0:
            up = wp.vec3(0.0, 0.0, c.gravity)
            force = c.mass * (acceleration_at(b, m, (float(t) + 0.5) * c.dt, coefficient) + up)
            axis = wp.normalize(acceleration_at(b, m, float(t + 1) * c.dt, coefficient) + up)
            z = rotate_back(q, axis)
            sine = wp.sqrt(z[0] * z[0] + z[1] * z[1])
            rate = wp.atan2(sine, z[2]) / (wp.max(sine, 1.0e-6) * c.dt)
            u = wp.vec4(wp.dot(force, rotation(q) * wp.vec3(0.0, 0.0, 1.0)), -rate * z[1], rate * z[0], yaw_rate)
        u = clamp_control(u, c)
        nominal[b, m, t] = u
        _p, _v, q = rk4(wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0), q, u, c)


BRAKING_CANDIDATES = wp.constant(5)
"""Braking candidates: straight ahead, and turned to both sides."""


@wp.func
def turned(v: wp.vec3, angle: float) -> wp.vec3:
    """Return v turned about the vertical axis."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    return wp.vec3(c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@wp.func
def write_brake(
    b: int, m: int, angle: float, p0: wp.vec3, v0: wp.vec3, a0: wp.vec3, q0: wp.vec4, c: Params,
    anchor: wp.array2d(dtype=wp.vec3), coefficient: wp.array3d(dtype=wp.vec3), guide: wp.array3d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
):  # fmt: skip
    """Write a guide that stops within brake_reach v T, `angle` to the left of the velocity, and its controls."""
    end = p0 + c.brake_reach * float(nominal.shape[2]) * c.dt * turned(v0, angle)
    anchor[b, m] = end
    write_guide(b, m, p0, v0, a0, end, wp.vec3(0.0, 0.0, 0.0), c.dt, coefficient, guide)
    follow_guide(b, m, q0, yaw(q0), c, coefficient, nominal)


@wp.kernel
def guides(
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    acceleration: wp.array(dtype=wp.vec3),
    time: wp.array(dtype=wp.float64),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    anchor_count: int,
    previous_index: int,
    brake_index: int,
    reach: wp.array(dtype=float),
    previous_end: wp.array(dtype=wp.vec3),
    previous_waypoint: wp.array(dtype=wp.vec3),
    previous_time: wp.array(dtype=wp.float64),
    anchor: wp.array2d(dtype=wp.vec3),
    elapsed: wp.array(dtype=float),
    coefficient: wp.array3d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
    waypoint: wp.array2d(dtype=wp.vec3),
):
    """Write the guide and the waypoint of every candidate. Launched over [B, M].

    `elapsed` becomes the time since the previous plan [s], or -1 if there is none to continue from.
    """
    b, m = wp.tid()
    c = params[b]
    p0 = position[b]
    T = float(guide.shape[2] - 1) * c.dt
    to_goal = goal_position[b] - p0
    v1 = wp.vec3(0.0, 0.0, 0.0)
    waypoint[b, m] = goal_position[b]
    if m < anchor_count:
        v1 = c.arrival_speed * wp.normalize(anchor[b, m] - p0)
        if reach[b] >= wp.length(to_goal):
            v1 = goal_velocity[b]
        elif reach[b] < c.waypoint_distance and c.waypoint_distance < wp.length(to_goal):
            waypoint[b, m] = p0 + c.waypoint_distance * wp.normalize(anchor[b, m] - p0)
    if m == previous_index:
        passed = float(time[b] - previous_time[b])
        if wp.isnan(time[b]) and not wp.isnan(previous_time[b]):
            passed = c.replan_period
        anchor[b, m] = previous_end[b]
        if not (passed >= 0.0 and passed < T):
            passed = float(-1.0)
            anchor[b, m] = p0 + reach[b] / wp.max(wp.length(to_goal), 1.0e-6) * to_goal
        elif wp.length(previous_waypoint[b] - p0) > reach[b]:
            waypoint[b, m] = previous_waypoint[b]
        elapsed[b] = passed
    if m == brake_index:
        anchor[b, m] = p0 + c.brake_reach * T * velocity[b]
    write_guide(b, m, p0, velocity[b], acceleration[b], anchor[b, m], v1, c.dt, coefficient, guide)


@wp.kernel
def nominal_controls(
    quaternion: wp.array(dtype=wp.vec4),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    previous_index: int,
    brake_index: int,
    previous_controls: wp.array2d(dtype=wp.vec4),
    elapsed: wp.array(dtype=float),
    coefficient: wp.array3d(dtype=wp.vec3),
    nominal: wp.array3d(dtype=wp.vec4),
):
    """Write the nominal controls of every candidate. Launched over [B, M]."""
    b, m = wp.tid()
    c = params[b]
    steps = nominal.shape[2]
    if m == previous_index and elapsed[b] >= 0.0:
        hover = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        for t in range(steps):
            s = float(t) + elapsed[b] / c.dt
            i = int(s)
            before = hover
            after = hover
            if i < steps:
                before = previous_controls[b, i]
            if i + 1 < steps:
                after = previous_controls[b, i + 1]
            nominal[b, m, t] = before + (s - float(i)) * (after - before)
        return
    heading = yaw(goal_quaternion[b])
    if m == brake_index:
        heading = yaw(quaternion[b])
    follow_guide(b, m, quaternion[b], heading, c, coefficient, nominal)
