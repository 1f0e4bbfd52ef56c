"""Prediction of the state at which a plan takes effect: commands act on the drone with a delay."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.anchors import flown_controls, time_since_plan
from aero_planner.kernels.dynamics import (
    lag_share,
    lag_shares,
    lagged_control,
    mean_lag_shares,
    rk4_step,
    thrust_axis,
    thrust_free_acceleration,
)
from aero_planner.kernels.guides import mean_control
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, PreviousPlan

wp.set_module_options({"enable_backward": False})

_STEP = wp.constant(0.01)
"""Longest step of the prediction [s]."""
_LARGEST_DRAG = wp.constant(0.5)
"""Largest drag that is believed [1/s]."""
_HALF_BELIEVED_SPEED = wp.constant(1.0)
"""Speed of flights at which half of the estimated drag is believed [m/s]: slow flights hardly show it."""
_LARGEST_DISTURBANCE = wp.constant(3.0)
"""Largest unexplained acceleration that is believed [m/s^2]: the drone may not fly what was planned."""


@wp.func
def lagged_attitude(q: wp.vec4, before: wp.vec4, since: float, lag: float) -> wp.vec4:
    """Return an attitude that follows q and is older by `lag` [s] on average; `before` is that of `since` [s] ago."""
    if not since >= 0.0:  # also if there is no plan before
        return q
    nearest = wp.where(wp.dot(before, q) < 0.0, -before, before)
    share = since / wp.max(since + lag, 1.0e-6)
    return wp.normalize(nearest + share * (q - nearest))


@wp.func
def believed_disturbance(d: wp.vec3) -> wp.vec3:
    """Return a disturbance, shortened to `_LARGEST_DISTURBANCE`."""
    return (_LARGEST_DISTURBANCE / wp.max(wp.length(d), _LARGEST_DISTURBANCE)) * d


@wp.func
def drag_sample(unexplained: wp.vec3, v: wp.vec3) -> wp.vec2:
    """Return -a v and v^2 of an unexplained acceleration a; their means have the drag as their ratio.

    This is the least-squares estimate of k in a = -k v. A drag beyond `_LARGEST_DRAG` is not believed.
    """
    square = wp.dot(v, v)
    return wp.vec2(wp.clamp(-wp.dot(unexplained, v), -_LARGEST_DRAG * square, _LARGEST_DRAG * square), square)


@wp.func
def counted_disturbance(mean: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return a disturbance without its component against the velocity.

    It shortens every stop, and may end with the motion. It is left as a margin.
    """
    against = wp.min(wp.dot(mean, v), 0.0) / wp.max(wp.dot(v, v), 1.0e-6)
    return mean - against * v


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
    mean_disturbance: wp.array(dtype=wp.vec3),
    drag_means: wp.array(dtype=wp.vec2),
    view_quaternion: wp.array(dtype=wp.vec4),
    # out
    start: DroneState,
):
    """Write the state after the delay of commands, under the commands of the previous plan that are still to act.

    The commands that arrive from now on are those that were sent one delay ago; the control in effect lags behind them.
    Without a delay the state is copied, with its attitude normalised. What the model does not explain is the difference
    of the given acceleration from that of the controls in effect, or is given. Its part against the velocity, in
    proportion to it, is the drag; the mean of the rest is the disturbance. Both are 0 in the first plan, and the
    disturbance also after a horizon without a plan or without an acceleration. `view_quaternion` follows the given
    attitude. Launched over [B].
    """
    b = wp.tid()
    c = params[b]
    p = drone.position[b]
    v = drone.velocity[b]
    q = wp.normalize(drone.quaternion[b])
    acceleration = drone.acceleration[b]
    since = time_since_plan(b, time[b], previous, c)
    horizon = float(previous.controls.shape[1]) * c.dt
    acting = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
    if since >= 0.0:
        _command, acting = flown_controls(b, wp.max(since - c.delay, 0.0), previous, c)
    no_disturbance = wp.vec3(0.0, 0.0, 0.0)
    unexplained = drone.disturbance[b]
    is_given = not wp.isnan(unexplained[0])
    if not is_given and since < horizon:  # NaN without an acceleration
        modelled = (acting[0] / c.mass) * thrust_axis(q) + thrust_free_acceleration(no_disturbance, c)
        unexplained = acceleration - modelled
    is_known = not wp.isnan(unexplained[0]) and (is_given or since >= 0.0)
    means = wp.vec2(0.0, 0.0)
    if since >= 0.0:
        means = drag_means[b]
    drag = float(0.0)
    if c.drag_time > 0.0:
        if is_known and since >= 0.0:
            means += (1.0 - lag_share(c.drag_time, since)) * (drag_sample(unexplained, v) - means)
        drag = wp.max(means[0], 0.0) / (means[1] + _HALF_BELIEVED_SPEED * _HALF_BELIEVED_SPEED)
    drag_means[b] = means
    disturbance = no_disturbance
    if c.disturbance_time > 0.0 and is_known:
        disturbance = believed_disturbance(unexplained + drag * v)
        if not is_given:
            mean_before = mean_disturbance[b]
            disturbance = mean_before + (1.0 - lag_share(c.disturbance_time, since)) * (disturbance - mean_before)
    if wp.isnan(acceleration[0]):
        acceleration = disturbance - drag * v
    counted = counted_disturbance(disturbance, v)
    acceleration += counted - disturbance
    mean_disturbance[b] = disturbance
    view_quaternion[b] = lagged_attitude(q, view_quaternion[b], since, c.view_age)
    if c.delay > 0.0:
        steps = int(wp.ceil(c.delay / _STEP - 1.0e-3))
        dt = c.delay / float(steps)
        u = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        shares = lag_shares(dt, c)
        mean_shares = mean_lag_shares(shares, dt, c)
        for k in range(steps):
            if since >= 0.0 and since < horizon:
                sent = wp.max(since - c.delay + (float(k) + 0.5) * dt, 0.0)
                u = mean_control(b, sent / c.dt, 1.0, c, previous.controls)
            mean = lagged_control(u, acting, mean_shares)
            acting = lagged_control(u, acting, shares)
            p, v, q = rk4_step(p, v, q, mean, c.mass, thrust_free_acceleration(disturbance, c), drag, dt)
        acceleration = (acting[0] / c.mass) * thrust_axis(q) + thrust_free_acceleration(counted, c) - drag * v
    start.position[b] = p
    start.velocity[b] = v
    start.quaternion[b] = q
    start.acceleration[b] = acceleration
    start.disturbance[b] = counted
    start.drag[b] = drag
