"""A vehicle that is commanded by its acceleration and yaw rate, as PX4's offboard mode and others take them.

State x = [p, q, v, a], control u = (a_c, psi_rate): dp = v, dv = a + d - k v, and the acceleration a in effect follows
the command a_c: da = (a_c - a) / tau. The autopilot turns the thrust to a - g; q is that attitude, with its yaw psi.
Along x and y, tau is the time constant of its attitude control, plus the lag of the body rates; along z it is the lag
of the thrust. The bounds are those of the airframe: thrust_min <= m |a - g| <= thrust_max, and a jerk along x and y of
at most rate_xy_max |g|, by which the thrust vector turns at its largest rate in hover.
"""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.device.lag import lag_share
from aero_planner.device.quintics import Quintic, force_at, guide_force
from aero_planner.device.rotations import quat_multiply
from aero_planner.models.vehicle_model import VehicleModel

wp.set_module_options({"enable_backward": False})

_ATTITUDE_LAG = wp.constant(0.08)
"""Time constant of the attitude control of flight stacks [s]: their gains from attitude to rates are 6 to 15 1/s."""
_TILT_TIME = wp.constant(0.2)
"""Time for which noise of the tilt rates of a quadrotor would act to give the noise of the acceleration [s]."""


@wp.struct
class Constants:
    """What is constant over all steps of a rollout."""

    dt: float  # [s]
    lag: float  # tau along x and y [s]
    reach: wp.vec3  # how far the acceleration goes toward the command in a step, see `reach_in`
    climb_share: float  # mean share of the difference along z that remains in a step
    gravity: float  # [m/s^2]
    disturbance: wp.vec3  # d, world frame [m/s^2]
    drag: float  # k [1/s]


@wp.func
def clamp(u: wp.vec4, params: Any) -> wp.vec4:
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
def noise(params: Any) -> wp.vec4:
    """Return the standard deviations of acceleration and yaw rate that the noise of a quadrotor's controls causes."""
    level = _TILT_TIME * params.gravity * wp.sqrt(params.variance_rate_xy)
    vertical = wp.sqrt(params.variance_thrust) / params.mass
    return wp.vec4(level, level, vertical, wp.sqrt(params.variance_rate_z))


@wp.func
def level_lag(params: Any) -> float:
    """Return tau along x and y [s]."""
    return _ATTITUDE_LAG + params.rate_lag


@wp.func
def reach_in(time: float, params: Any) -> wp.vec3:
    """Return how far the acceleration goes toward its command in a time [s].

    It goes a share of the way along x and y, at most so far [m/s^2], and a share of the way along z.
    """
    level = 1.0 - lag_share(level_lag(params), time)
    return wp.vec3(level, time * params.rate_xy_max * params.gravity, 1.0 - lag_share(params.thrust_lag, time))


@wp.func
def toward(a: wp.vec4, u: wp.vec4, reach: wp.vec3) -> wp.vec4:
    """Return the acceleration a after it has gone toward u as far as `reach_in` says, with the yaw rate of u."""
    x = u[0] - a[0]
    y = u[1] - a[1]
    level = wp.min(reach[0], reach[1] / wp.max(wp.sqrt(x * x + y * y), 1.0e-6))
    return wp.vec4(a[0] + level * x, a[1] + level * y, a[2] + reach[2] * (u[2] - a[2]), u[3])


@wp.func
def respond(u: wp.vec4, acting: wp.vec4, time: float, params: Any) -> wp.vec4:
    """Return the acceleration in effect after u was commanded for a time [s]."""
    return toward(acting, u, reach_in(time, params))


@wp.func
def constants(disturbance: wp.vec3, drag: float, dt: float, params: Any) -> Constants:
    """Return the constants of steps of dt [s]."""
    k = Constants()
    k.dt = dt
    k.lag = level_lag(params)
    k.reach = reach_in(dt, params)
    k.climb_share = params.thrust_lag * k.reach[2] / dt
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
    """Return p, v, q and the acceleration in effect after a step, at the mean acceleration in it."""
    after = toward(acting, u, k.reach)
    climb = u[2] + k.climb_share * (acting[2] - u[2])
    mean = wp.vec3(0.5 * (acting[0] + after[0]), 0.5 * (acting[1] + after[1]), climb)
    a = mean + k.disturbance - k.drag * v
    return p + k.dt * v + (0.5 * k.dt * k.dt) * a, v + k.dt * a, attitude(after, q, k), after


@wp.func
def acceleration(v: wp.vec3, q: wp.vec4, acting: wp.vec4, k: Constants) -> wp.vec3:
    """Return a + d - k v."""
    return wp.vec3(acting[0], acting[1], acting[2]) + k.disturbance - k.drag * v


@wp.func
def follow(
    p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, guide: Quintic, time: float, yaw_rate: float, k: Constants,
    params: Any,
) -> wp.vec4:  # fmt: skip
    """Return the acceleration with which to follow a guide, less disturbance and drag.

    It leads the guide by the lag. Along x and y, it also makes up for the acceleration in effect at the beginning.
    """
    force = guide_force(guide, k.disturbance, k.drag)
    middle = time + 0.5 * k.dt
    missing = force_at(force, wp.min(time, guide.T)) - wp.vec3(acting[0], acting[1], acting[2])
    level = force_at(force, wp.min(middle + k.lag, guide.T)) + missing
    climb = force_at(force, wp.min(middle + params.thrust_lag, guide.T))
    return clamp(wp.vec4(level[0], level[1], climb[2], yaw_rate), params)


ACCELERATION = VehicleModel(
    name="acceleration",
    label="Acceleration and yaw rate",
    controls=(("a_x", "m/s^2"), ("a_y", "m/s^2"), ("a_z", "m/s^2"), ("yaw_rate", "rad/s")),
    clamp=clamp,
    noise=noise,
    respond=respond,
    constants=constants,
    step=step,
    acceleration=acceleration,
    follow=follow,
)
