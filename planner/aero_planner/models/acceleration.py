"""A vehicle that is commanded by its acceleration and yaw rate, as PX4's offboard mode and others take them.

State x = [p, q, v, a], control u = (a_c, psi_rate): dp = v, dv = a + d - k v, and the acceleration a in effect follows
the command a_c with a bounded jerk. The autopilot turns the thrust to a - g; q is that attitude, with its yaw psi. The
bounds are those of the airframe: thrust_min <= m |a - g| <= thrust_max, and a jerk of rate_xy_max |g|, by which the
thrust vector turns at its largest rate in hover.
"""

# Postponed annotations are left out: Warp structs need the types themselves.

import warp as wp

from aero_planner.device.params import Params
from aero_planner.device.quintics import Quintic, force_at, guide_force
from aero_planner.device.rotations import heading, quat_multiply, wrap_angle
from aero_planner.models.vehicle_model import VehicleModel

wp.set_module_options({"enable_backward": False})

_TILT_TIME = wp.constant(0.2)
"""Time for which noise of the tilt rates of a quadrotor would act to give the noise of the acceleration [s]."""


@wp.struct
class Constants:
    """What is constant over all steps of a rollout."""

    dt: float  # [s]
    jerk: float  # largest change of the acceleration in a step [m/s^2]
    gravity: float  # [m/s^2]
    disturbance: wp.vec3  # d, world frame [m/s^2]
    drag: float  # k [1/s]


@wp.func
def clamp(u: wp.vec4, params: Params) -> wp.vec4:
    """Return u with the thrust per mass a - g and the yaw rate within their bounds.

    A thrust that is too large keeps its direction, unless that leaves less than the smallest thrust upward.
    """
    lowest = params.thrust_min / params.mass
    largest = params.thrust_max / params.mass
    f = wp.vec3(u[0], u[1], wp.max(u[2] + params.gravity, lowest))
    f = wp.min(1.0, largest / wp.max(wp.length(f), 1.0e-6)) * f
    up = wp.max(f[2], lowest)
    level = wp.sqrt(wp.max(largest * largest - up * up, 0.0) / wp.max(f[0] * f[0] + f[1] * f[1], 1.0e-12))
    level = wp.min(1.0, level)
    return wp.vec4(
        level * f[0], level * f[1], up - params.gravity, wp.clamp(u[3], -params.rate_z_max, params.rate_z_max)
    )


@wp.func
def hover(params: Params) -> wp.vec4:
    """Return no acceleration."""
    return wp.vec4(0.0, 0.0, 0.0, 0.0)


@wp.func
def noise(params: Params) -> wp.vec4:
    """Return the standard deviations of acceleration and yaw rate that the noise of a quadrotor's controls causes."""
    level = _TILT_TIME * params.gravity * wp.sqrt(params.variance_rate_xy)
    vertical = wp.sqrt(params.variance_thrust) / params.mass
    return wp.vec4(level, level, vertical, wp.sqrt(params.variance_rate_z))


@wp.func
def toward(a: wp.vec4, u: wp.vec4, change: float) -> wp.vec4:
    """Return the acceleration a after it has gone toward u by at most `change`, with the yaw rate of u."""
    d = wp.vec3(u[0] - a[0], u[1] - a[1], u[2] - a[2])
    d = wp.min(1.0, change / wp.max(wp.length(d), 1.0e-6)) * d
    return wp.vec4(a[0] + d[0], a[1] + d[1], a[2] + d[2], u[3])


@wp.func
def respond(u: wp.vec4, acting: wp.vec4, time: float, params: Params) -> wp.vec4:
    """Return the acceleration in effect after u was commanded for a time [s]."""
    return toward(acting, u, time * params.rate_xy_max * params.gravity)


@wp.func
def constants(disturbance: wp.vec3, drag: float, dt: float, params: Params) -> Constants:
    """Return the constants of steps of dt [s]."""
    k = Constants()
    k.dt = dt
    k.jerk = dt * params.rate_xy_max * params.gravity
    k.gravity = params.gravity
    k.disturbance = disturbance
    k.drag = drag
    return k


@wp.func
def attitude(a: wp.vec4, q: wp.vec4, k: Constants) -> wp.vec4:
    """Return the attitude whose thrust gives a, after a step at the yaw rate a[3] from that of q."""
    # Of q = tilt (x) yaw, the yaw is (w, 0, 0, z), normalised.
    half = 0.5 * k.dt * a[3]
    yaw = wp.normalize(wp.vec4(q[0] - half * q[3], 0.0, 0.0, q[3] + half * q[0]))
    z = wp.normalize(wp.vec3(a[0], a[1], a[2] + k.gravity))
    tilt = wp.normalize(wp.vec4(1.0 + z[2], -z[1], z[0], 0.0))
    return quat_multiply(tilt, yaw)


@wp.func
def step(p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, u: wp.vec4, k: Constants):
    """Return p, v, q and the acceleration in effect after a step, at the mean of the accelerations before and after."""
    after = toward(acting, u, k.jerk)
    mean = wp.vec3(acting[0] + after[0], acting[1] + after[1], acting[2] + after[2])
    a = 0.5 * mean + k.disturbance - k.drag * v
    return p + k.dt * v + (0.5 * k.dt * k.dt) * a, v + k.dt * a, attitude(after, q, k), after


@wp.func
def acceleration(v: wp.vec3, q: wp.vec4, acting: wp.vec4, k: Constants) -> wp.vec3:
    """Return a + d - k v."""
    return wp.vec3(acting[0], acting[1], acting[2]) + k.disturbance - k.drag * v


@wp.func
def follow(
    b: int,
    i: int,
    guide: Quintic,
    q0: wp.vec4,
    command: wp.vec4,
    acting: wp.vec4,
    heading_goal: float,
    k: Constants,
    params: Params,
    controls: wp.array3d(dtype=wp.vec4),
):
    """Write the accelerations of a guide, less disturbance and drag; the heading turns at a constant rate."""
    steps = controls.shape[2]
    yaw_rate = wrap_angle(heading_goal - heading(q0)) / (float(steps) * k.dt)
    required = guide_force(guide, k.disturbance, k.drag)
    for t in range(steps):
        a = force_at(required, wp.min((float(t) + 1.0) * k.dt, guide.T))
        controls[b, i, t] = clamp(wp.vec4(a[0], a[1], a[2], yaw_rate), params)


ACCELERATION = VehicleModel(
    name="acceleration",
    label="Acceleration and yaw rate",
    controls=(("a_x", "m/s^2"), ("a_y", "m/s^2"), ("a_z", "m/s^2"), ("yaw_rate", "rad/s")),
    clamp=clamp,
    hover=hover,
    noise=noise,
    respond=respond,
    constants=constants,
    step=step,
    acceleration=acceleration,
    follow=follow,
)
