"""Quintic guides to the endpoints, and nominal controls that follow them."""

# Postponed annotations are left out: kernels made for a composition refer to local types.

import functools

import warp as wp

from aero_planner.composition import Composition
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.quintics import Quintic, guide_position, quintic
from aero_planner.device.records import Cells, GuideSet, PreviousPlan, Problem, Start
from aero_planner.device.rotations import heading, quat_from_heading, quat_rotate, wrap_angle
from aero_planner.kernels.anchors import safe_anchor
from aero_planner.kernels.prediction import mean_control, time_since_plan

wp.set_module_options({"enable_backward": False})

BRAKING_FAN = wp.constant(5)
"""Braking candidates, the first rows after the M instances: straight ahead, then alternately left and right."""
FAN_ANGLE = wp.constant(30.0 * 3.14159265 / 180.0)
"""Angle between them [rad]."""


NEAR_GOAL = wp.constant(0.5)
"""Distance within which guides that stop at the goal take less time, to 0.6 of the horizon [m]: a drone that hovers
must come back fast from where a gust has moved it."""


@wp.func
def guide_time(goal_distance: float, T: float, params: Params) -> float:
    """Return the duration of a guide that stops at the goal [s]; without lookahead_time, it is T as in the paper."""
    share = wp.clamp(goal_distance / NEAR_GOAL, 0.6, 1.0)
    return wp.where(params.lookahead_time > 0.0, share * T, T)


@wp.func
def braking_angle(candidate: int) -> float:
    """Return the angle of a braking candidate to the left of the velocity: 0, 1, -1, 2, -2 times `FAN_ANGLE` [rad]."""
    side = wp.where(candidate % 2 == 1, 1.0, -1.0)
    return side * float((candidate + 1) // 2) * FAN_ANGLE


@wp.func
def braking_end(p: wp.vec3, v: wp.vec3, angle: float, T: float, params: Params) -> wp.vec3:
    """Return where a braking guide ends that turns by an angle [rad]: brake_reach |v| T ahead [m], world frame."""
    return p + (params.brake_reach * T) * quat_rotate(quat_from_heading(angle), v)


@wp.func
def write_guide(b: int, m: int, lane: int, lanes: int, c: Quintic, dt: float, guides: GuideSet):
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


@functools.cache
def make_guides(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that makes the guides, with `tuning.threads_per_instance` threads per instance."""
    LANES = wp.constant(tuning.threads_per_instance)
    refine = safe_anchor(tuning.threads_per_instance)
    model = composition.model
    constants, step, follow, respond = model.constants, model.step, model.follow, model.respond
    mean_of = mean_control(model)
    Views, turn = composition.Views, composition.hooks.turn

    @wp.kernel(module="unique", enable_backward=False)
    def make_guides(
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        anchor_count: int,
        previous_index: int,
        # in
        cells: Cells,
        initial_directions: wp.array2d(dtype=wp.vec3),
        previous: PreviousPlan,
        views: Views,
        # out
        guides: GuideSet,
        nominal_controls: wp.array3d(dtype=wp.vec4),
    ):
        """Write endpoint, guide and nominal controls of the M instances and the braking candidates.

        Launched over [B, M + BRAKING_FAN, LANES]; the lanes share the time steps.
        """
        b, m, lane = wp.tid()
        c = params[b]
        p0 = start.position[b]
        v0 = start.velocity[b]
        q0 = start.quaternion[b]
        T = float(nominal_controls.shape[2]) * c.dt
        to_goal = problem.goal[b] - p0
        goal_distance = wp.length(to_goal)
        p1 = braking_end(p0, v0, braking_angle(wp.max(m - instances, 0)), T, c)
        v1 = wp.vec3(0.0, 0.0, 0.0)
        heading_goal = heading(start.goal_quaternion[b])
        elapsed = float(-1.0)
        duration = T
        if m < anchor_count:
            p1 = refine(b, m, lane, start, cells, initial_directions)
            if start.lookahead[b] >= goal_distance:
                v1 = start.goal_velocity[b]
                if wp.length(v1) == 0.0:
                    duration = guide_time(goal_distance, T, c)
        elif m == previous_index:
            elapsed = time_since_plan(b, problem.time[b], previous, c)
            p1 = previous.end[b]
            if not (elapsed >= 0.0 and elapsed < T):
                elapsed = float(-1.0)
                p1 = p0 + (start.lookahead[b] / wp.max(goal_distance, 1.0e-6)) * to_goal
        else:
            heading_goal = heading(q0)
        if lane == 0:
            guides.anchors[b, m] = p1
            if m >= anchor_count:
                guides.initial_endpoints[b, m] = p1
        curve = quintic(p0, v0, start.acceleration[b], p1, v1, duration)
        write_guide(b, m, lane, LANES, curve, c.dt, guides)
        if elapsed >= 0.0:
            for t in range(lane, nominal_controls.shape[2], LANES):
                nominal_controls[b, m, t] = mean_of(b, float(t) + elapsed / c.dt, 1.0, c, previous.controls)
        elif lane == 0:
            # Only the part of the state that the model needs to follow the guide is computed.
            k = constants(start.disturbance[b], start.drag[b], c.dt, c)
            yaw_rate = wrap_angle(heading_goal - heading(q0)) / T
            along = wp.where(m < anchor_count, p1 - p0, v0)
            goal_heading = heading(start.goal_quaternion[b])
            p = p0
            v = v0
            q = q0
            acting = start.control[b]
            before = start.command[b]
            for t in range(nominal_controls.shape[2]):
                rate = turn(yaw_rate, q, along, goal_heading, views, c)
                u = follow(p, v, q, acting, curve, float(t) * c.dt, rate, k, c)
                # Where jumps have a price, controls approach what the guide asks for. Braking begins at once.
                if m < anchor_count and c.q_control_jump > 0.0:
                    u = respond(u, before, c.dt, c)
                before = u
                nominal_controls[b, m, t] = u
                p, v, q, acting = step(p, v, q, acting, u, k)

    return tuning.set_options(make_guides)
