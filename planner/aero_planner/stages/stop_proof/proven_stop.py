"""The stop that was proven last: it is continued as a row of each plan, and replaced by the stop of what is flown."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.quintics import quintic
from aero_planner.device.records import Choice, GuideSet, PreviousPlan, Problem, Rollouts, Scores, Start
from aero_planner.kernels.guides import braking_end, write_guide
from aero_planner.kernels.prediction import mean_control, time_since_plan
from aero_planner.stages.stop_proof.stops import STOPS, Stops, clear_stop, stop_to_keep, switch_step

wp.set_module_options({"enable_backward": False})


@wp.struct
class ProvenStop:
    """The stop that was proven last."""

    proven_stop: wp.array2d(dtype=wp.vec4)  # [B, 2 N], its controls
    proven_stop_age: wp.array(dtype=float)  # [B], time from that plan to the previous one [s]; infinite: none
    stop_ready: wp.array(dtype=int)  # [B], 1 where it is left to fly
    stop_command: wp.array(dtype=wp.vec4)  # [B], its mean control until the next plan


@functools.cache
def continue_stop(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that writes the row of the proven stop."""
    LANES = wp.constant(tuning.threads_per_instance)
    model = composition.model
    constants, step, follow, mean_of = model.constants, model.step, model.follow, mean_control(model)

    @wp.kernel(module="unique", enable_backward=False)
    def continue_stop(
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        # in
        previous: PreviousPlan,
        # in and out
        proven: ProvenStop,
        # out
        guides: GuideSet,
        nominal_controls: wp.array3d(dtype=wp.vec4),
    ):
        """Continue the proven stop as the last row, or brake where there is none. Launched over [B, LANES]."""
        b, lane = wp.tid()
        c = params[b]
        row = nominal_controls.shape[1] - 1
        steps = nominal_controls.shape[2]
        T = float(steps) * c.dt
        since = time_since_plan(b, problem.time[b], previous, c)
        p0 = start.position[b]
        v0 = start.velocity[b]
        end = braking_end(p0, v0, 0.0, T, c)
        guide = quintic(p0, v0, start.acceleration[b], end, wp.vec3(0.0, 0.0, 0.0), T)
        write_guide(b, row, lane, LANES, guide, c.dt, guides)
        # A stop has two horizons of controls.
        elapsed = proven.proven_stop_age[b] + since
        ready = since >= 0.0 and elapsed < 2.0 * T
        shift = elapsed / c.dt
        if ready:
            for t in range(lane, steps, LANES):
                nominal_controls[b, row, t] = mean_of(b, float(t) + shift, 1.0, c, proven.proven_stop)
        if lane > 0:
            return
        guides.anchors[b, row] = end
        guides.initial_endpoints[b, row] = end
        proven.stop_ready[b] = wp.where(ready, 1, 0)
        if ready:
            width = wp.clamp(start.period[b] / c.dt, 1.0e-3, 1.0)
            proven.stop_command[b] = mean_of(b, shift, width, c, proven.proven_stop)
        else:
            k = constants(start.disturbance[b], start.drag[b], c.dt, c)
            p = p0
            v = v0
            q = start.quaternion[b]
            acting = start.control[b]
            for t in range(steps):
                u = follow(p, v, q, acting, guide, float(t) * c.dt, 0.0, k, c)
                nominal_controls[b, row, t] = u
                p, v, q, acting = step(p, v, q, acting, u, k)

    return tuning.set_options(continue_stop)


@functools.cache
def keep_stop(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that keeps the stop of what is flown."""
    LANES = wp.constant(tuning.threads_per_instance)
    hover = composition.model.hover

    @wp.kernel(module="unique", enable_backward=False)
    def keep_stop(
        # problem
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        # in
        choice: Choice,
        scores: Scores,
        stops: Stops,
        # in and out
        rollouts: Rollouts,
        previous: PreviousPlan,
        proven: ProvenStop,
    ):
        """Keep the controls of the stop, of twice the length of the horizon. Launched over [B, LANES]."""
        b, lane = wp.tid()
        c = params[b]
        row = rollouts.controls.shape[1] - 1
        steps = rollouts.controls.shape[2]
        if c.prove_stop == 0:
            proven.proven_stop_age[b] = wp.INF
            return
        m = choice.best[b]
        if choice.flown[b] == row:
            if lane == 0:
                # What is flown until the next plan is the stop itself; its rollout has the mean over the time step.
                rollouts.controls[b, m, 0] = proven.stop_command[b]
                previous.controls[b, 0] = proven.stop_command[b]
                proven.proven_stop_age[b] = proven.proven_stop_age[b] + start.period[b]
            return
        stop = int(-1)
        switch = steps
        if choice.replaced[b] < 0:
            demanded = clear_stop(scores.static_clearance[b, m, scores.static_clearance.shape[2] - 1], c)
            stop = stop_to_keep(b, m, demanded, stops.stop_clearance)
            switch = switch_step(stop % STOPS, steps, start.period[b], c.dt)
        for k in range(lane, 2 * steps, LANES):
            kept = hover(c)
            if k < switch:
                kept = previous.controls[b, k]
            elif stop >= 0 and k - switch < steps:
                kept = stops.stop_controls[b, stop, k - switch]
            proven.proven_stop[b, k] = kept
        if lane == 0:
            proven.proven_stop_age[b] = 0.0

    return tuning.set_options(keep_stop)
