"""Prediction of the state at which a plan takes effect: commands act on the drone with a delay."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.hook_records import Estimate
from aero_planner.device.params import Params
from aero_planner.device.records import PreviousPlan, Problem, Start
from aero_planner.kernels.clearance import goal_between_heights
from aero_planner.models.vehicle_model import VehicleModel

wp.set_module_options({"enable_backward": False})

_STEP = wp.constant(0.01)
"""Longest step of the prediction [s]."""
UNSTAMPED_PERIOD = wp.constant(0.02)
"""Time between two plans where states carry no time [s]."""


@wp.func
def time_since_plan(b: int, time: wp.float64, previous: PreviousPlan, params: Params) -> float:
    """Return the time since the previous plan [s]; NaN if there is none."""
    # The difference is taken in float64, since stamps may count from 1970.
    elapsed = float(time - previous.time[b])
    if wp.isnan(time) and not wp.isnan(previous.time[b]):
        elapsed = UNSTAMPED_PERIOD
    return elapsed


@functools.cache
def flown_controls(model: VehicleModel) -> wp.Function:
    """Return the function that follows the commands of the previous plan."""
    hover, respond = model.hover, model.respond

    @wp.func
    def flown_controls(b: int, elapsed: float, previous: PreviousPlan, params: Params):
        """Return command and control in effect when the previous plan has been flown for a time [s]; hover if not."""
        command = hover(params)
        control = command
        steps = previous.controls.shape[1]
        if elapsed >= 0.0 and elapsed < float(steps) * params.dt:
            control = previous.start_control[b]
            whole = int(elapsed / params.dt)
            for t in range(whole):
                control = respond(previous.controls[b, t], control, params.dt, params)
            command = previous.controls[b, wp.min(whole, steps - 1)]
            control = respond(command, control, elapsed - float(whole) * params.dt, params)
        return command, control

    return flown_controls


@functools.cache
def mean_control(model: VehicleModel) -> wp.Function:
    """Return the function that finds the mean of a sequence of controls over a part of it."""
    hover = model.hover

    @wp.func
    def mean_control(
        b: int, start: float, width: float, params: Params, controls: wp.array2d(dtype=wp.vec4)
    ) -> wp.vec4:
        """Return the mean of a sequence of controls over a part of it; past its end the drone hovers.

        Args:
            b: drone.
            start: begin of the part after that of the sequence, in time steps.
            width: length of the part, in time steps, at most 1.
            params: live parameters.
            controls: [B, any].
        """
        i = int(start)
        u0 = hover(params)
        u1 = u0
        if i < controls.shape[1]:
            u0 = controls[b, i]
        if i + 1 < controls.shape[1]:
            u1 = controls[b, i + 1]
        share = wp.max(0.0, start - float(i) - (1.0 - width)) / width
        return u0 + share * (u1 - u0)

    return mean_control


@functools.cache
def predict_state(composition: Composition) -> wp.Kernel:
    """Return the kernel that predicts the state at which the plan takes effect."""
    Views, model, estimate = composition.Views, composition.model, composition.hooks.estimate
    hover, constants, step, acceleration_of = model.hover, model.constants, model.step, model.acceleration
    controls_in_effect, mean_of = flown_controls(model), mean_control(model)

    @wp.kernel(module="unique", enable_backward=False)
    def predict_state(
        # problem, of which the goal is out
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        previous: PreviousPlan,
        views: Views,
        # out
        start: Start,
    ):
        """Write the goal that is flown to, and the state after the delay of commands, under those of the previous plan
        that are still to act.

        The commands that arrive from now on are those that were sent one delay ago; the control in effect lags behind
        them. Without a delay the state is copied, with its attitude normalised. Launched over [B].
        """
        b = wp.tid()
        c = params[b]
        problem.goal[b] = goal_between_heights(problem.given_goal[b], problem.ground_height[b], c)
        p = problem.position[b]
        v = problem.velocity[b]
        q = wp.normalize(problem.quaternion[b])
        since = time_since_plan(b, problem.time[b], previous, c)
        horizon = float(previous.controls.shape[1]) * c.dt
        zero = wp.vec3(0.0, 0.0, 0.0)
        acting = hover(c)
        if since >= 0.0:
            _command, acting = controls_in_effect(b, wp.max(since - c.delay, 0.0), previous, c)
        e = Estimate()
        e.since = since
        e.horizon = horizon
        e.velocity = v
        e.measured = problem.acceleration[b]
        e.modelled = acceleration_of(v, q, acting, constants(zero, 0.0, c.dt, c))
        e.given = problem.disturbance[b]
        e.acting = zero
        e.fed_forward = zero
        e.drag = 0.0
        e = estimate(b, e, views, c)
        acceleration = e.measured
        if wp.isnan(acceleration[0]):
            acceleration = e.acting - e.drag * v
        acceleration += e.fed_forward - e.acting
        if c.delay > 0.0:
            steps = int(wp.ceil(c.delay / _STEP - 1.0e-3))
            dt = c.delay / float(steps)
            u = hover(c)
            k = constants(e.acting, e.drag, dt, c)
            for i in range(steps):
                if since >= 0.0 and since < horizon:
                    sent = wp.max(since - c.delay + (float(i) + 0.5) * dt, 0.0)
                    u = mean_of(b, sent / c.dt, 1.0, c, previous.controls)
                p, v, q, acting = step(p, v, q, acting, u, k)
            acceleration = acceleration_of(v, q, acting, constants(e.fed_forward, e.drag, dt, c))
        start.position[b] = p
        start.velocity[b] = v
        start.quaternion[b] = q
        start.acceleration[b] = acceleration
        start.disturbance[b] = e.fed_forward
        start.drag[b] = e.drag

    return predict_state
