"""Quintic guides to the endpoints, and nominal controls that follow them by differential flatness."""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools

import warp as wp

from aero_planner.kernels.anchors import safe_anchor, time_since_plan
from aero_planner.kernels.dynamics import (
    clamp_control,
    heading,
    lag_share,
    lag_shares,
    lagged_control,
    mean_lag_shares,
    near_atan2,
    quat_from_heading,
    quat_inverse_rotate,
    quat_rotate,
    rotate_by_rates,
    thrust_axis,
    thrust_free_acceleration,
)
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, GoalState, GuideSet, PreviousPlan

wp.set_module_options({"enable_backward": False})


@wp.func
def wrap_angle(angle: float) -> float:
    """Return the angle wrapped to [-pi, pi)."""
    return angle - 2.0 * wp.PI * wp.floor(angle / (2.0 * wp.PI) + 0.5)


@wp.struct
class Quintic:
    """Coefficients a_0 .. a_5 of a guide, world frame, SI units."""

    a0: wp.vec3
    a1: wp.vec3
    a2: wp.vec3
    a3: wp.vec3
    a4: wp.vec3
    a5: wp.vec3


@wp.func
def quintic(p0: wp.vec3, v0: wp.vec3, acceleration0: wp.vec3, p1: wp.vec3, v1: wp.vec3, T: float) -> Quintic:
    """Return the quintic from (p0, v0, acceleration0) at time 0 to (p1, v1, 0) at time T, in closed form."""
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
    """Return the position of a guide at time s."""
    return c.a0 + s * (c.a1 + s * (c.a2 + s * (c.a3 + s * (c.a4 + s * c.a5))))


@wp.struct
class GuideThrust:
    """Coefficients of the thrust per mass that follows a guide, b0 + b1 s + .. + b4 s^4 [m/s^2], world frame."""

    b0: wp.vec3
    b1: wp.vec3
    b2: wp.vec3
    b3: wp.vec3
    b4: wp.vec3


@wp.func
def guide_thrust(c: Quintic, g: wp.vec3, drag: float) -> GuideThrust:
    """Return a - g + drag v along a guide; g is the acceleration without thrust and drag [m/s^2]."""
    f = GuideThrust()
    f.b0 = 2.0 * c.a2 + drag * c.a1 - g
    f.b1 = 6.0 * c.a3 + (2.0 * drag) * c.a2
    f.b2 = 12.0 * c.a4 + (3.0 * drag) * c.a3
    f.b3 = 20.0 * c.a5 + (4.0 * drag) * c.a4
    f.b4 = (5.0 * drag) * c.a5
    return f


@wp.func
def thrust_at(f: GuideThrust, s: float) -> wp.vec3:
    """Return the thrust per mass at time s of a guide."""
    return f.b0 + s * (f.b1 + s * (f.b2 + s * (f.b3 + s * f.b4)))


@wp.func
def write_guide(
    b: int,
    m: int,
    lane: int,
    lanes: int,
    c: Quintic,
    dt: float,
    guides: GuideSet,
):
    """Write the coefficients of a guide and its positions at t = 0, dt, .., T."""
    if lane == 0:
        guides.coefficients[b, m, 0] = c.a0
        guides.coefficients[b, m, 1] = c.a1
        guides.coefficients[b, m, 2] = c.a2
        guides.coefficients[b, m, 3] = c.a3
        guides.coefficients[b, m, 4] = c.a4
        guides.coefficients[b, m, 5] = c.a5
    for t in range(lane, guides.positions.shape[2], lanes):
        guides.positions[b, m, t] = guide_position(c, float(t) * dt)


@wp.func
def write_nominal(
    b: int,
    m: int,
    c: Quintic,
    q0: wp.vec4,
    command: wp.vec4,
    control: wp.vec4,
    disturbance: wp.vec3,
    drag: float,
    heading_goal: float,
    lag: float,
    params: Params,
    nominal_controls: wp.array3d(dtype=wp.vec4),
):
    """Write the controls that follow a guide: F_t and omega from the flat outputs position and heading.

    The guide determines the thrust vector m (a - g - d + drag v) and with it the body z axis. The body rates
    turn the attitude reached so far to the required axis at the end of each time step, which also corrects an initial
    attitude that does not fit the guide. The heading turns at a constant rate to that of the goal.

    With a rate lag tau, the rates correct the attitude within dt + 2 tau instead of dt, which is the fastest correction
    that does not overshoot by more than 5 percent, and follow the axis that is required that much later.

    With a `lag` [s] of these controls the body rates also approach what the guide requires from those of the `command`
    in force, in place of jumping there, and correct the attitude that much later.
    """
    dt = params.dt
    steps = nominal_controls.shape[2]
    yaw_rate = wrap_angle(heading_goal - heading(q0)) / (float(steps) * dt)
    required = guide_thrust(c, thrust_free_acceleration(disturbance, params), drag)
    q = q0
    acting = control
    shares = lag_shares(dt, params)
    mean_shares = mean_lag_shares(shares, dt, params)
    before = command
    remaining = lag_share(lag, dt)
    lead = 2.0 * params.rate_xy_lag + lag
    end = float(steps) * dt
    f_next = thrust_at(required, 0.5 * dt)
    z_next = wp.normalize(thrust_at(required, wp.min(dt + lead, end)))
    for t in range(steps):
        f = f_next
        z_body = quat_inverse_rotate(q, z_next)
        # Values that do not depend on the attitude are computed one step early, off the chain of dependent operations.
        f_next = thrust_at(required, (float(t) + 1.5) * dt)
        z_next = wp.normalize(thrust_at(required, wp.min(float(t + 2) * dt + lead, end)))
        # The shortest rotation of the body z axis is about e_3 x z_body, by the angle between them.
        sine = wp.sqrt(z_body[0] * z_body[0] + z_body[1] * z_body[1])
        gain = near_atan2(sine, z_body[2]) / (wp.max(sine, 1.0e-6) * (dt + lead))
        u = wp.vec4(params.mass * wp.dot(f, thrust_axis(q)), -gain * z_body[1], gain * z_body[0], yaw_rate)
        if params.nominal != 0:
            u = wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)
        u = clamp_control(u, params)
        u = lagged_control(u, before, wp.vec4(0.0, remaining, remaining, remaining))
        before = u
        nominal_controls[b, m, t] = u
        mean = lagged_control(u, acting, mean_shares)
        acting = lagged_control(u, acting, shares)
        q = rotate_by_rates(q, wp.vec3(mean[1], mean[2], mean[3]), dt)


@wp.func
def mean_control(b: int, start: float, width: float, params: Params, controls: wp.array2d(dtype=wp.vec4)) -> wp.vec4:
    """Return the mean of a sequence of controls over a part of it; past its end the drone hovers.

    Args:
        start: begin of the part after that of the sequence, in time steps.
        width: length of the part, in time steps, at most 1.
    """
    hover = wp.vec4(params.mass * params.gravity, 0.0, 0.0, 0.0)
    i = int(start)
    u0 = hover
    u1 = hover
    if i < controls.shape[1]:
        u0 = controls[b, i]
    if i + 1 < controls.shape[1]:
        u1 = controls[b, i + 1]
    share = wp.max(0.0, start - float(i) - (1.0 - width)) / width
    return u0 + share * (u1 - u0)


BRAKING_FAN = wp.constant(5)
"""Braking guides: straight ahead, then alternately to the left and to the right."""
BRAKING_CANDIDATES = wp.constant(6)
"""Braking candidates after the M instances: the braking guides, then the stop that was proven last."""


@wp.func
def braking_angle(candidate: int, params: Params) -> float:
    """Return the angle of a braking candidate to the left of the velocity: 0, 1, -1, 2, -2 times brake_fan [rad]."""
    side = wp.where(candidate % 2 == 1, 1.0, -1.0)
    return side * float((candidate + 1) // 2) * wp.radians(params.brake_fan)


@functools.cache
def make_guides(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that makes the guides, with `tuning.threads_per_instance` threads per instance."""
    LANES = wp.constant(tuning.threads_per_instance)
    refine = safe_anchor(tuning.threads_per_instance)

    @wp.kernel(module="unique", enable_backward=False)
    def make_guides(
        # problem
        drone: DroneState,
        time: wp.array(dtype=wp.float64),
        goal: GoalState,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        anchor_count: int,
        previous_index: int,
        fine_cells: int,
        coarse_rows: int,
        coarse_columns: int,
        # in
        fine_range: wp.array2d(dtype=float),
        directions: wp.array2d(dtype=wp.vec3),
        lookahead_length: wp.array(dtype=float),
        clip_guides: wp.array(dtype=int),
        initial_directions: wp.array2d(dtype=wp.vec3),
        previous: PreviousPlan,
        # out
        guides: GuideSet,
        waypoints: wp.array2d(dtype=wp.vec3),
        nominal_controls: wp.array3d(dtype=wp.vec4),
        plan_period: wp.array(dtype=float),
        stop_ready: wp.array(dtype=int),
        stop_command: wp.array(dtype=wp.vec4),
    ):
        """Write endpoint, guide and nominal controls of the M instances and the braking candidates.

        The cost-to-go follows a path from the end of a rollout by a waypoint to the goal. The waypoint of an anchor is
        on the line to the anchor at waypoint_distance, if that is beyond the end of the guide and before the goal;
        otherwise it is the goal. A braking candidate stops within brake_reach v T. A `time` of NaN means one
        replan_period after the previous plan. Launched over [B, R, LANES]; the lanes share the time steps.
        """
        b, m, lane = wp.tid()
        c = params[b]
        p0 = drone.position[b]
        q0 = drone.quaternion[b]
        lookahead = lookahead_length[b]
        T = float(nominal_controls.shape[2]) * c.dt
        to_goal = goal.position[b] - p0
        goal_distance = wp.length(to_goal)
        angle = braking_angle(wp.max(m - instances, 0), c)
        braking_velocity = quat_rotate(quat_from_heading(angle), drone.velocity[b])
        waypoint = goal.position[b]
        p1 = p0 + (c.brake_reach * T) * braking_velocity
        v1 = wp.vec3(0.0, 0.0, 0.0)
        heading_goal = heading(goal.quaternion[b])
        elapsed = float(-1.0)
        since = time_since_plan(b, time[b], previous, c)
        period = wp.where(since > 0.0, since, c.replan_period)
        is_stop = m == instances + BRAKING_CANDIDATES - 1
        if m < anchor_count:
            p1 = refine(
                b, m, lane, p0, q0, c, fine_cells, coarse_rows, coarse_columns, fine_range, directions,
                lookahead, clip_guides[b], initial_directions,
            )  # fmt: skip
            v1 = c.arrival_speed * wp.normalize(p1 - p0)
            if lookahead >= goal_distance:
                v1 = goal.velocity[b]
            elif c.waypoint_distance > lookahead and c.waypoint_distance < goal_distance:
                waypoint = p0 + c.waypoint_distance * wp.normalize(p1 - p0)
        elif m == previous_index:
            elapsed = since
            p1 = previous.end[b]
            if not (elapsed >= 0.0 and elapsed < T):
                elapsed = float(-1.0)
                p1 = p0 + (lookahead / wp.max(goal_distance, 1.0e-6)) * to_goal
            elif wp.length(previous.waypoint[b] - p0) > lookahead:
                waypoint = previous.waypoint[b]
        else:
            heading_goal = heading(q0)
            # A stop has two horizons of controls.
            if is_stop and since >= 0.0 and previous.stop_age[b] + since < 2.0 * T:
                elapsed = previous.stop_age[b] + since
        if lane == 0:
            if is_stop:
                stop_ready[b] = wp.where(elapsed >= 0.0, 1, 0)
                plan_period[b] = period
            guides.anchors[b, m] = p1
            waypoints[b, m] = waypoint
            if m >= anchor_count:
                guides.initial_endpoints[b, m] = p1
        curve = quintic(p0, drone.velocity[b], drone.acceleration[b], p1, v1, T)
        write_guide(b, m, lane, LANES, curve, c.dt, guides)
        shift = elapsed / c.dt
        if elapsed >= 0.0:
            for t in range(lane, nominal_controls.shape[2], LANES):
                if is_stop:
                    nominal_controls[b, m, t] = mean_control(b, float(t) + shift, 1.0, c, previous.stop)
                else:
                    nominal_controls[b, m, t] = mean_control(b, float(t) + shift, 1.0, c, previous.controls)
            if is_stop and lane == 0:
                stop_command[b] = mean_control(b, shift, wp.clamp(period / c.dt, 1.0e-3, 1.0), c, previous.stop)
        elif lane == 0:
            # Braking is urgent and begins at once.
            lag = wp.where(m < anchor_count, c.nominal_lag, 0.0)
            write_nominal(
                b, m, curve, q0, drone.command[b], drone.control[b], drone.disturbance[b], drone.drag[b], heading_goal,
                lag, c, nominal_controls,
            )  # fmt: skip

    return tuning.set_options(make_guides)
