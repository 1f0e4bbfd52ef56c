"""Prediction of the state at which a plan takes effect: commands act on the drone with a delay."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.anchors import flown_controls, time_since_plan
from aero_planner.kernels.dynamics import lag_shares, lagged_control, mean_lag_shares, rk4_step, thrust_axis
from aero_planner.kernels.guides import mean_control
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, PreviousPlan

wp.set_module_options({"enable_backward": False})

_STEP = wp.constant(0.01)
"""Longest step of the prediction [s]."""


@wp.func
def lagged_attitude(q: wp.vec4, before: wp.vec4, since: float, lag: float) -> wp.vec4:
    """Return an attitude that follows q and is older by `lag` [s] on average; `before` is that of `since` [s] ago."""
    if not since >= 0.0:  # also if there is no plan before
        return q
    nearest = wp.where(wp.dot(before, q) < 0.0, -before, before)
    share = since / wp.max(since + lag, 1.0e-6)
    return wp.normalize(nearest + share * (q - nearest))


@wp.kernel
def predict_state(
    # problem
    drone: DroneState,
    time: wp.array(dtype=wp.float64),
    # configuration
    params: wp.array(dtype=Params),
    # in
    previous: PreviousPlan,
    # in and out
    view_quaternion: wp.array(dtype=wp.vec4),
    # out
    start: DroneState,
):
    """Write the state after the delay of commands, under the commands of the previous plan that are still to act.

    The commands that arrive from now on are those that were sent one delay ago; the control in effect lags behind them.
    Without a delay the state is copied, with its attitude normalised. `view_quaternion` follows the given attitude.
    Launched over [B].
    """
    b = wp.tid()
    c = params[b]
    p = drone.position[b]
    v = drone.velocity[b]
    q = wp.normalize(drone.quaternion[b])
    acceleration = drone.acceleration[b]
    since = time_since_plan(b, time[b], previous, c)
    view_quaternion[b] = lagged_attitude(q, view_quaternion[b], since, c.view_age)
    if c.delay > 0.0:
        steps = int(wp.ceil(c.delay / _STEP - 1.0e-3))
        dt = c.delay / float(steps)
        u = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        acting = u
        if since >= 0.0:
            _command, acting = flown_controls(b, wp.max(since - c.delay, 0.0), previous, c)
        shares = lag_shares(dt, c)
        mean_shares = mean_lag_shares(shares, dt, c)
        horizon = float(previous.controls.shape[1]) * c.dt
        for k in range(steps):
            if since >= 0.0 and since < horizon:
                sent = wp.max(since - c.delay + (float(k) + 0.5) * dt, 0.0)
                u = mean_control(b, sent / c.dt, 1.0, c, previous.controls)
            mean = lagged_control(u, acting, mean_shares)
            acting = lagged_control(u, acting, shares)
            p, v, q = rk4_step(p, v, q, mean, c.mass, c.gravity, dt)
        acceleration = (acting[0] / c.mass) * thrust_axis(q) - wp.vec3(0.0, 0.0, c.gravity)
    start.position[b] = p
    start.velocity[b] = v
    start.quaternion[b] = q
    start.acceleration[b] = acceleration
