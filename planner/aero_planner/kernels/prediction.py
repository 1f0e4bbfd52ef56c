"""Prediction of the state at which a plan takes effect: commands act on the drone with a delay."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.dynamics import rk4_step, thrust_axis
from aero_planner.kernels.guides import shifted_control
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, PreviousPlan

__all__ = ["predict_state"]

wp.set_module_options({"enable_backward": False})

_STEP = wp.constant(0.01)
"""Longest step of the prediction [s]."""


@wp.kernel
def predict_state(
    # problem
    drone: DroneState,
    time: wp.array(dtype=wp.float64),
    # configuration
    params: wp.array(dtype=Params),
    # in
    previous: PreviousPlan,
    # out
    start: DroneState,
):
    """Write the state after the delay of commands, under the commands of the previous plan that are still to act.

    A lag of first order is taken as a delay by its time constant. The commands that act from now on are those that were
    sent one delay ago. Without a delay the state is copied, with its attitude normalised. Launched over [B].
    """
    b = wp.tid()
    c = params[b]
    p = drone.position[b]
    v = drone.velocity[b]
    q = wp.normalize(drone.quaternion[b])
    acceleration = drone.acceleration[b]
    if c.delay > 0.0:
        since = float(time[b] - previous.time[b])
        if wp.isnan(time[b]) and not wp.isnan(previous.time[b]):
            since = c.replan_period
        steps = int(wp.ceil(c.delay / _STEP - 1.0e-3))
        dt = c.delay / float(steps)
        u = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        horizon = float(previous.controls.shape[1]) * c.dt
        for k in range(steps):
            if since >= 0.0 and since < horizon:
                sent = wp.max(since - c.delay + (float(k) + 0.5) * dt, 0.0)
                u = shifted_control(b, 0, sent, c, previous.controls)
            p, v, q = rk4_step(p, v, q, u, c.mass, c.gravity, dt)
        acceleration = (u[0] / c.mass) * thrust_axis(q) - wp.vec3(0.0, 0.0, c.gravity)
    start.position[b] = p
    start.velocity[b] = v
    start.quaternion[b] = q
    start.acceleration[b] = acceleration
