"""Quintic guides to the endpoints and the nominal controls that follow from them by differential flatness."""

from __future__ import annotations

import functools

import warp as wp

from aero_planner.kernels.anchors import safe_anchor
from aero_planner.kernels.dynamics import (
    clamp_control,
    heading,
    near_atan2,
    quat_from_heading,
    quat_inverse_rotate,
    quat_rotate,
    rotate_by_rates,
    thrust_axis,
)
from aero_planner.kernels.kernel_tuning import Widths
from aero_planner.kernels.params import Params

__all__ = ["BRAKES", "Quintic", "make_guides", "quintic", "wrap_angle", "write_nominal"]

wp.set_module_options({"enable_backward": False})


@wp.func
def wrap_angle(angle: float) -> float:
    """Angle in [-pi, pi)."""
    return angle - 2.0 * wp.PI * wp.floor(angle / (2.0 * wp.PI) + 0.5)


@wp.struct
class Quintic:
    """Coefficients a_0..a_5 of a guide."""

    a0: wp.vec3
    a1: wp.vec3
    a2: wp.vec3
    a3: wp.vec3
    a4: wp.vec3
    a5: wp.vec3


@wp.func
def quintic(p0: wp.vec3, v0: wp.vec3, acceleration0: wp.vec3, p1: wp.vec3, v1: wp.vec3, T: float) -> Quintic:
    """The quintic that leaves (p0, v0, acceleration0) at 0 and reaches (p1, v1, 0) at T, in closed form."""
    dp = p1 - p0 - T * v0 - (0.5 * T * T) * acceleration0
    dv = T * (v1 - v0 - T * acceleration0)
    da = (-0.5 * T * T) * acceleration0
    T3 = T * T * T
    c = Quintic()
    c.a0 = p0
    c.a1 = v0
    c.a2 = 0.5 * acceleration0
    c.a3 = (10.0 * dp - 4.0 * dv + da) / T3
    c.a4 = (-15.0 * dp + 7.0 * dv - 2.0 * da) / (T3 * T)
    c.a5 = (6.0 * dp - 3.0 * dv + da) / (T3 * T * T)
    return c


@wp.func
def guide_position(c: Quintic, s: float) -> wp.vec3:
    """Position of a guide at time s."""
    return c.a0 + s * (c.a1 + s * (c.a2 + s * (c.a3 + s * (c.a4 + s * c.a5))))


@wp.func
def guide_acceleration(c: Quintic, s: float) -> wp.vec3:
    """Second derivative of a guide at time s."""
    return 2.0 * c.a2 + s * (6.0 * c.a3 + s * (12.0 * c.a4 + s * (20.0 * c.a5)))


@wp.func
def write_guide(
    b: int,
    m: int,
    lane: int,
    lanes: int,
    c: Quintic,
    dt: float,
    coefficient: wp.array3d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
):
    """Write the guide's coefficients and its samples at t = 0, dt, .., T."""
    if lane == 0:
        coefficient[b, m, 0] = c.a0
        coefficient[b, m, 1] = c.a1
        coefficient[b, m, 2] = c.a2
        coefficient[b, m, 3] = c.a3
        coefficient[b, m, 4] = c.a4
        coefficient[b, m, 5] = c.a5
    for t in range(lane, guide.shape[2], lanes):
        guide[b, m, t] = guide_position(c, float(t) * dt)


@wp.func
def write_nominal(
    b: int, m: int, c: Quintic, q0: wp.vec4, heading_goal: float, params: Params, nominal: wp.array3d(dtype=wp.vec4)
):
    """Write the controls that follow a guide: F_t and omega from the flat outputs position and heading.

    The guide's acceleration fixes the thrust vector m (a - g) and so the body's z axis. Rates turn the attitude reached
    so far to the axis wanted at the end of each step, which also takes up an attitude that does not fit the guide at
    its start; the heading turns evenly to the goal's.
    """
    dt = params.dt
    steps = nominal.shape[2]
    turn = wrap_angle(heading_goal - heading(q0)) / (float(steps) * dt)
    up = wp.vec3(0.0, 0.0, params.gravity)
    q = q0
    f_ahead = guide_acceleration(c, 0.5 * dt) + up
    z_ahead = wp.normalize(guide_acceleration(c, dt) + up)
    for t in range(steps):
        f = f_ahead
        z_body = quat_inverse_rotate(q, z_ahead)
        # What does not need the attitude is computed ahead, so that only what does waits for it.
        f_ahead = guide_acceleration(c, (float(t) + 1.5) * dt) + up
        z_ahead = wp.normalize(guide_acceleration(c, float(t + 2) * dt) + up)
        # Shortest rotation from the body's z axis: about e_3 x z_body, by the angle between them.
        sine = wp.sqrt(z_body[0] * z_body[0] + z_body[1] * z_body[1])
        gain = near_atan2(sine, z_body[2]) / (wp.max(sine, 1.0e-6) * dt)
        u = wp.vec4(params.mass * wp.dot(f, thrust_axis(q)), -gain * z_body[1], gain * z_body[0], turn)
        if params.nominal != 0:
            u = wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)
        u = clamp_control(u, params)
        nominal[b, m, t] = u
        q = rotate_by_rates(q, wp.vec3(u[1], u[2], u[3]), dt)


@wp.func
def write_previous(
    b: int,
    m: int,
    lane: int,
    lanes: int,
    elapsed: float,
    params: Params,
    previous: wp.array2d(dtype=wp.vec4),
    nominal: wp.array3d(dtype=wp.vec4),
):
    """Write the previous best controls, shifted by the elapsed time; past their end the drone hovers."""
    steps = nominal.shape[2]
    hover = wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)
    shift = elapsed / params.dt
    for t in range(lane, steps, lanes):
        s = float(t) + shift
        i = int(s)
        u0 = hover
        u1 = hover
        if i < steps:
            u0 = previous[b, i]
        if i + 1 < steps:
            u1 = previous[b, i + 1]
        nominal[b, m, t] = u0 + (s - float(i)) * (u1 - u0)


BRAKES = wp.constant(5)
"""Ways to brake: straight ahead, then to both sides."""


@wp.func
def brake_direction(way: int, params: Params) -> float:
    """Angle of a way to brake from straight ahead [rad], to the left: 0, 1, -1, 2, -2 times brake_fan."""
    side = wp.where(way % 2 == 1, 1.0, -1.0)
    return side * float((way + 1) // 2) * wp.radians(params.brake_fan)


@functools.cache
def make_guides(of: Widths) -> wp.Kernel:
    """Return the kernel with `of.steps` threads for an instance."""
    LANES = wp.constant(of.steps)

    @wp.kernel(module="unique", enable_backward=False)
    def make_guides(
        position: wp.array(dtype=wp.vec3),
        velocity: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.vec4),
        acceleration: wp.array(dtype=wp.vec3),
        time: wp.array(dtype=wp.float64),
        goal_position: wp.array(dtype=wp.vec3),
        goal_velocity: wp.array(dtype=wp.vec3),
        goal_quaternion: wp.array(dtype=wp.vec4),
        params: wp.array(dtype=Params),
        instances: int,
        anchor_count: int,
        previous_index: int,
        fine_range: wp.array2d(dtype=float),
        directions: wp.array2d(dtype=wp.vec3),
        initial_direction: wp.array2d(dtype=wp.vec3),
        pool: int,
        coarse_rows: int,
        coarse_columns: int,
        reach: wp.array(dtype=float),
        previous_controls: wp.array2d(dtype=wp.vec4),
        previous_end: wp.array(dtype=wp.vec3),
        previous_turn: wp.array(dtype=wp.vec3),
        previous_time: wp.array(dtype=wp.float64),
        initial_endpoint: wp.array2d(dtype=wp.vec3),
        anchor: wp.array2d(dtype=wp.vec3),
        coefficient: wp.array3d(dtype=wp.vec3),
        guide: wp.array3d(dtype=wp.vec3),
        turn: wp.array2d(dtype=wp.vec3),
        nominal: wp.array3d(dtype=wp.vec4),
    ):
        """Endpoint, guide and nominal controls of the M instances, and then of the ways to brake. Launched over [B, M +
        BRAKES, of.steps], which share the steps.

        `turn` is where the way beyond a guide, of which the cost-to-go asks whether it is blocked, turns to the goal:
        on the line to the anchor at waypoint_distance, where that lies beyond the guide's end and before the goal, and
        the goal itself otherwise. Braking stops within brake_reach v T. `previous_time` is NaN when there is no
        previous plan; a `time` of NaN means one replan_period later.
        """
        b, m, lane = wp.tid()
        c = params[b]
        p0 = position[b]
        q0 = quaternion[b]
        T = float(nominal.shape[2]) * c.dt
        to_goal = goal_position[b] - p0
        goal_distance = wp.length(to_goal)
        aside = brake_direction(wp.max(m - instances, 0), c)
        ahead = quat_rotate(quat_from_heading(aside), velocity[b])
        way_turn = goal_position[b]
        p1 = p0 + (c.brake_reach * T) * ahead
        v1 = wp.vec3(0.0, 0.0, 0.0)
        heading_goal = heading(goal_quaternion[b])
        elapsed = float(-1.0)
        if m < anchor_count:
            p1 = safe_anchor(
                b,
                m,
                p0,
                q0,
                c.refine,
                fine_range,
                directions,
                reach,
                initial_direction,
                pool,
                coarse_rows,
                coarse_columns,
            )
            v1 = c.arrival_speed * wp.normalize(p1 - p0)
            if reach[b] >= goal_distance:
                v1 = goal_velocity[b]
            elif c.waypoint_distance > reach[b] and c.waypoint_distance < goal_distance:
                way_turn = p0 + c.waypoint_distance * wp.normalize(p1 - p0)
        elif m == previous_index:
            # Compared in float64, since stamps may count from 1970.
            elapsed = float(time[b] - previous_time[b])
            if wp.isnan(time[b]) and not wp.isnan(previous_time[b]):
                elapsed = c.replan_period
            p1 = previous_end[b]
            if not (elapsed >= 0.0 and elapsed < T):
                elapsed = float(-1.0)
                p1 = p0 + (reach[b] / wp.max(goal_distance, 1.0e-6)) * to_goal
            elif wp.length(previous_turn[b] - p0) > reach[b]:
                way_turn = previous_turn[b]
        else:
            heading_goal = heading(q0)
        if lane == 0:
            anchor[b, m] = p1
            turn[b, m] = way_turn
            if m >= anchor_count:
                initial_endpoint[b, m] = p1
        curve = quintic(p0, velocity[b], acceleration[b], p1, v1, T)
        write_guide(b, m, lane, LANES, curve, c.dt, coefficient, guide)
        if elapsed >= 0.0:
            write_previous(b, m, lane, LANES, elapsed, c, previous_controls, nominal)
        elif lane == 0:
            write_nominal(b, m, curve, q0, heading_goal, c, nominal)

    return of.tune(make_guides)
