"""Stops of the candidates: their own controls up to a switch time, then a braking manoeuvre as long as the horizon."""

# Postponed annotations are left out: Warp functions need the types themselves.

import functools

import warp as wp

from aero_planner.kernels.dynamics import (
    clamp_control,
    lag_shares,
    lagged_control,
    mean_lag_shares,
    near_atan2,
    quat_from_heading,
    quat_inverse_rotate,
    quat_rotate,
    rk4_step,
    thrust_axis,
    thrust_free_acceleration,
)
from aero_planner.kernels.guides import guide_thrust, quintic, thrust_at
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.params import Params
from aero_planner.kernels.partition import cell_of_direction
from aero_planner.kernels.records import DroneState, Rollouts

wp.set_module_options({"enable_backward": False})

ALWAYS_SEEN = wp.constant(0.5)
"""Distance from the drone up to which nothing is hidden [m]."""
STOPS = wp.constant(6)
"""Stops of a candidate: three that leave it at once, straight ahead and to either side, and three that leave it after a
quarter, half and all of the horizon."""


@wp.func
def switch_step(stop: int, steps: int, period: float, params: Params) -> int:
    """Return the time step at which a stop leaves its candidate; the first ones after the time until the next plan."""
    first = wp.clamp(int(wp.ceil(period / params.dt - 1.0e-3)), 1, steps)
    step = first
    if stop == 3:
        step = steps // 4
    if stop == 4:
        step = steps // 2
    if stop == 5:
        step = steps
    return wp.max(step, first)


@wp.func
def stop_angle(stop: int, params: Params) -> float:
    """Return the angle of the braking manoeuvre to the left of the velocity [rad]."""
    side = float(0.0)
    if stop == 1:
        side = 1.0
    if stop == 2:
        side = -1.0
    return side * wp.radians(params.brake_fan)


@wp.func
def control_at_step(
    b: int, m: int, step: int, control: wp.vec4, params: Params, controls: wp.array3d(dtype=wp.vec4)
) -> wp.vec4:
    """Return the control in effect at the beginning of a time step of a rollout; `control` is that at its start."""
    shares = lag_shares(params.dt, params)
    for t in range(step):
        control = lagged_control(controls[b, m, t], control, shares)
    return control


@wp.func
def safe_clearances(start_clearance: float, params: Params):
    """Return the least clearance of a safe instance, and that of a clear stop [m].

    For a drone that is nearer than that at the start, it is safe not to come nearer still.
    """
    safe = params.safe_clearance
    stop_safe = wp.min(params.stop_clearance, params.safe_clearance)
    if start_clearance < safe:
        safe = start_clearance - 0.02
    if start_clearance < stop_safe:
        stop_safe = start_clearance - 0.005
    return safe, stop_safe


@wp.func
def widest_stop_limit(stop_safe: float, params: Params) -> float:
    """Return the clearance above which a stop that is not clear is preferred to braking that is not clear either [m].

    With less than half of what is asked contact is certain, and braking makes it slow. Only candidates that need not be
    safe beyond their stop have such a stop.
    """
    is_preferred = params.widest_stop != 0 and params.prove_stop == 2 and params.prefer_safe != 0
    return wp.where(is_preferred, 0.5 * stop_safe, wp.INF)


@wp.func
def mover_allowances(clearance: float, standing_clearance: float, params: Params):
    """Return how much nearer than what stands moving obstacles may come to a safe instance, and to a clear stop [m].

    Both are 0 unless a moving obstacle is near at the start. Arguments are the clearances of the start, with and
    without moving obstacles. What is asked of what stands does not depend on what moves.
    """
    safe, stop_safe = safe_clearances(clearance, params)
    standing_safe, standing_stop_safe = safe_clearances(standing_clearance, params)
    return standing_safe - safe, standing_stop_safe - stop_safe


@wp.func
def seen_range(
    b: int, row: int, column: int, rows: int, columns: int, params: Params, fine_range: wp.array2d(dtype=float)
) -> float:
    """Return the range up to which a fine cell is seen [m].

    With `stop_seen_closing`, it is at most that of the farther of the two cells beside it, and of those above and below
    it: between points of a surface, a cell may be empty because no beam has hit it.
    """
    seen = fine_range[b, row * columns + column]
    if params.stop_seen_closing != 0:
        left = fine_range[b, row * columns + (column + columns - 1) % columns]
        right = fine_range[b, row * columns + (column + 1) % columns]
        above = fine_range[b, wp.min(row + 1, rows - 1) * columns + column]
        below = fine_range[b, wp.max(row - 1, 0) * columns + column]
        seen = wp.min(seen, wp.min(wp.max(left, right), wp.max(above, below)))
    return seen


@wp.func
def is_hidden(
    b: int,
    x: wp.vec3,
    position: wp.vec3,
    quaternion: wp.vec4,
    rows: int,
    columns: int,
    params: Params,
    fine_range: wp.array2d(dtype=float),
) -> bool:
    """Return True if x is farther away than `ALWAYS_SEEN`, and not seen from the drone."""
    to_x = quat_inverse_rotate(wp.normalize(quaternion), x - position)
    distance = wp.length(to_x)
    hidden = bool(False)
    if distance > ALWAYS_SEEN:
        row, column = cell_of_direction(to_x, rows, columns)
        hidden = distance > seen_range(b, row, column, rows, columns, params, fine_range)
    return hidden


@wp.func
def roll_out_stop(
    b: int,
    i: int,
    drone: DroneState,
    c: Params,
    plan_period: wp.array(dtype=float),
    rollouts: Rollouts,
    stop_controls: wp.array3d(dtype=wp.vec4),
    stop_positions: wp.array3d(dtype=wp.vec3),
    stop_clearance: wp.array2d(dtype=float),
):
    """Roll out the braking manoeuvre of stop i."""
    m = i // STOPS
    stop = i % STOPS
    steps = stop_controls.shape[2]
    dt = c.dt
    T = float(steps) * dt
    s = switch_step(stop, steps, plan_period[b], c)
    p = rollouts.positions[b, m, s]
    v = rollouts.velocities[b, m, s]
    q = rollouts.quaternions[b, m, s]
    g = thrust_free_acceleration(drone.disturbance[b], c)
    drag = drone.drag[b]
    acting = control_at_step(b, m, s, drone.control[b], c, rollouts.controls)
    shares = lag_shares(dt, c)
    mean_shares = mean_lag_shares(shares, dt, c)
    lead = 2.0 * c.rate_xy_lag  # as in `write_nominal`
    acceleration = (acting[0] / c.mass) * thrust_axis(q) + g - drag * v
    goal = p + (c.brake_reach * T) * quat_rotate(quat_from_heading(stop_angle(stop, c)), v)
    required = guide_thrust(quintic(p, v, acceleration, goal, wp.vec3(0.0, 0.0, 0.0), T), g, drag)
    stop_positions[b, i, 0] = p
    for t in range(steps):
        f = thrust_at(required, (float(t) + 0.5) * dt)
        later = wp.min(float(t + 1) * dt + lead, T)
        z_body = quat_inverse_rotate(q, wp.normalize(thrust_at(required, later)))
        sine = wp.sqrt(z_body[0] * z_body[0] + z_body[1] * z_body[1])
        gain = near_atan2(sine, z_body[2]) / (wp.max(sine, 1.0e-6) * (dt + lead))
        u = wp.vec4(c.mass * wp.dot(f, thrust_axis(q)), -gain * z_body[1], gain * z_body[0], 0.0)
        u = clamp_control(u, c)
        mean = lagged_control(u, acting, mean_shares)
        acting = lagged_control(u, acting, shares)
        p, v, q = rk4_step(p, v, q, mean, c.mass, g, drag, dt)
        stop_controls[b, i, t] = u
        stop_positions[b, i, t + 1] = p
    # A manoeuvre that has not stopped proves nothing.
    stop_clearance[b, i] = wp.where(wp.length(v) < c.stop_speed, c.safe_clearance, 0.0)


@functools.cache
def roll_out_stops(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that rolls out the braking manoeuvre of every stop."""

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out_stops(
        # problem
        finished: wp.array(dtype=int),
        drone: DroneState,
        # configuration
        params: wp.array(dtype=Params),
        # in
        plan_period: wp.array(dtype=float),
        rollouts: Rollouts,
        # out
        stop_controls: wp.array3d(dtype=wp.vec4),
        stop_positions: wp.array3d(dtype=wp.vec3),
        stop_clearance: wp.array2d(dtype=float),
    ):
        """Roll out the braking manoeuvre of every stop. Launched over [B, stops]."""
        b, i = wp.tid()
        if finished[b] != 0:
            return
        c = params[b]
        if c.prove_stop == 0:
            return
        roll_out_stop(b, i, drone, c, plan_period, rollouts, stop_controls, stop_positions, stop_clearance)

    return tuning.set_options(roll_out_stops)
