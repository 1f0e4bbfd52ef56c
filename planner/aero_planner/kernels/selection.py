"""Stage II: roll out the optimised controls, select the best instance, and brake if none is safe.

The M instances are followed by the braking candidates. If no instance is safe, a braking candidate replaces one.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.best_instance import select_best
from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at, query_limit, safety_limit
from aero_planner.kernels.costs import collision_cost, goal_cost, jump_cost, speed_cost
from aero_planner.kernels.dynamics import (
    lag_shares,
    lagged_control,
    mean_lag_shares,
    rk4_step,
    thrust_free_acceleration,
)
from aero_planner.kernels.escape import Escape, escape_cost, remember_place
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.kernel_tuning import KernelTuning
from aero_planner.kernels.movers import Movers, clear_of_movers
from aero_planner.kernels.mppi import PROBES, blocked_cost, probe_position
from aero_planner.kernels.params import Params
from aero_planner.kernels.records import DroneState, GoalState, GuideSet, InstanceCosts, PreviousPlan, Rollouts
from aero_planner.kernels.stops import STOPS, is_hidden, mover_allowances, switch_step
from aero_planner.kernels.warp_ops import minimum_over, point_pack, read_lane, sum_over

wp.set_module_options({"enable_backward": False})

_HIDDEN = wp.constant(1.0)
"""Distance by which a braking guide that leads into unseen space counts as nearer to obstacles [m]."""


@functools.cache
def roll_out_controls(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel of the Stage II rollouts, with `tuning.threads_per_instance` threads per instance."""
    LANES = wp.constant(tuning.threads_per_instance)

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out_controls(
        # problem
        drone: DroneState,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        # in
        nominal_controls: wp.array3d(dtype=wp.vec4),
        # in (controls of the instances) and out
        rollouts: Rollouts,
    ):
        """Roll out the optimised controls of the instances and the nominal controls of the braking candidates.

        Launched over [B, R, LANES]. The lanes read the controls of as many time steps at once.
        """
        b, m, lane = wp.tid()
        c = params[b]
        p = drone.position[b]
        v = drone.velocity[b]
        q = drone.quaternion[b]
        if lane == 0:
            rollouts.positions[b, m, 0] = p
            rollouts.velocities[b, m, 0] = v
            rollouts.quaternions[b, m, 0] = q
        acting = drone.control[b]
        g = thrust_free_acceleration(drone.disturbance[b], c)
        drag = drone.drag[b]
        shares = lag_shares(c.dt, c)
        mean_shares = mean_lag_shares(shares, c.dt, c)
        steps = rollouts.controls.shape[2]
        for first in range(0, steps, LANES):
            t_lane = wp.min(first + lane, steps - 1)
            u_lane = wp.where(m < instances, rollouts.controls[b, m, t_lane], nominal_controls[b, m, t_lane])
            rollouts.controls[b, m, t_lane] = u_lane
            for t in range(first, wp.min(first + LANES, steps)):
                step = t - first
                u = wp.vec4(
                    read_lane(u_lane[0], step), read_lane(u_lane[1], step),
                    read_lane(u_lane[2], step), read_lane(u_lane[3], step),
                )  # fmt: skip
                mean = lagged_control(u, acting, mean_shares)
                acting = lagged_control(u, acting, shares)
                p, v, q = rk4_step(p, v, q, mean, c.mass, g, drag, c.dt)
                if lane == 0:
                    rollouts.positions[b, m, t + 1] = p
                    rollouts.velocities[b, m, t + 1] = v
                    rollouts.quaternions[b, m, t + 1] = q

    return tuning.set_options(roll_out_controls)


@functools.cache
def evaluate_states(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that evaluates Stage II states, with `tuning.threads_per_query` threads per position."""
    clearance_of = clearance_at(tuning.points_per_pack, tuning.threads_per_query)
    Pack: Any = point_pack(tuning.points_per_pack)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_states(
        # problem
        finished: wp.array(dtype=int),
        drone: DroneState,
        center: wp.array(dtype=wp.vec3),
        ground_height: wp.array(dtype=float),
        goal: GoalState,
        movers: Movers,
        # configuration
        params: wp.array(dtype=Params),
        duplicate_rows: int,
        # in
        cell_ends: wp.array2d(dtype=int),
        point_packs: wp.array2d(dtype=Pack),
        waypoints: wp.array2d(dtype=wp.vec3),
        rollouts: Rollouts,
        # out
        clearance: wp.array3d(dtype=float),
        state_terms: wp.array3d(dtype=wp.vec4),
        standing_clearance: wp.array3d(dtype=float),
    ):
        """Evaluate costs and clearance of the N states, the PROBES of the cost-to-go, the N midpoints between states,
        and the start, in this order.

        `state_terms` are J_goal, J_col, the speed cost and the clearance [m]; `standing_clearance` is that without
        what moves. Launched over [B, R, N + PROBES + N + 1, threads per query].
        """
        b, m, t, thread = wp.tid()
        if finished[b] != 0:
            return
        c = params[b]
        steps = rollouts.positions.shape[2] - 1
        x = rollouts.positions[b, m, wp.min(t + 1, steps)]
        limit = query_limit(t, steps, c)
        margin = float(0.0)
        time = float(t + 1) * c.dt
        if t >= steps + PROBES:
            # The last row is the start, as the midpoint between the start and itself.
            half = (t - steps - PROBES) % steps
            half_end = wp.where(t == state_terms.shape[2] - 1, half, half + 1)
            x = 0.5 * (rollouts.positions[b, m, half] + rollouts.positions[b, m, half_end])
            # A midpoint faster than the speed limit is below its margin in open space, too, and counts as unsafe. That
            # limit is the one for which the grid is made, and the speed cost keeps candidates near it.
            limit = safety_limit(c)
            time = (float(half) + 0.5 * float(half_end - half)) * c.dt
            margin = c.speed_margin * wp.length(rollouts.velocities[b, m, half])
            if t == state_terms.shape[2] - 1:
                margin = 0.0
        elif t >= steps:
            x = probe_position(x, waypoints[b, m], goal.position[b], t - steps, c)
        d = clearance_of(x, limit, b, thread, center[b], cell_size(c), duplicate_rows, cell_ends, point_packs)
        d = above_ground(d, x, ground_height[b], c)
        standing = d
        if t < steps or t >= steps + PROBES:
            d = clear_of_movers(d, x, time, b, movers, c)
        J_goal = float(0.0)
        J_speed = float(0.0)
        if t < steps:
            v = rollouts.velocities[b, m, t + 1]
            q = rollouts.quaternions[b, m, t + 1]
            J_goal = goal_cost(x, v, q, goal.position[b], goal.velocity[b], goal.quaternion[b], c)
            J_speed = speed_cost(v, c)
            margin = c.speed_margin * wp.length(v)
            clearance[b, m, t] = wp.min(d, c.distance_max)
        state_terms[b, m, t] = wp.vec4(J_goal, collision_cost(d, c), J_speed, d - margin)
        standing_clearance[b, m, t] = standing - margin

    return tuning.set_options(evaluate_states, keep_loops=True)


@functools.cache
def score_instances(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that sums S2, with `tuning.threads_per_instance` threads per instance."""
    THREADS = wp.constant(tuning.threads_per_instance)
    minimum, total = minimum_over(tuning.threads_per_instance), sum_over(tuning.threads_per_instance)

    @wp.kernel(module="unique", enable_backward=False)
    def score_instances(
        # problem
        position: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.vec4),
        goal_position: wp.array(dtype=wp.vec3),
        command: wp.array(dtype=wp.vec4),
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        previous_index: int,
        rows: int,
        columns: int,
        # in
        fine_range: wp.array2d(dtype=float),
        escape: Escape,
        waypoints: wp.array2d(dtype=wp.vec3),
        controls: wp.array3d(dtype=wp.vec4),
        positions: wp.array3d(dtype=wp.vec3),
        state_terms: wp.array3d(dtype=wp.vec4),
        standing_clearance: wp.array3d(dtype=float),
        # out
        costs: InstanceCosts,
        instance_scores: wp.array2d(dtype=wp.vec3),
    ):
        """Sum S2 of each instance and its terms.

        `instance_scores` are S2, the minimum clearance, for which what moves counts as farther away by the first of
        `mover_allowances`, and the minimum clearance without what moves [m]. Both are less by `_HIDDEN` for a braking
        guide that leads into space that is not seen. Launched over [B, R, THREADS].
        """
        b, m, thread = wp.tid()
        c = params[b]
        steps = positions.shape[2] - 1
        start = state_terms.shape[2] - 1
        allowance, _ = mover_allowances(state_terms[b, m, start][3], standing_clearance[b, m, start], c)
        sums = wp.vec4(0.0, 0.0, 0.0, 0.0)
        nearest = float(wp.INF)
        nearest_standing = float(wp.INF)
        blocked = float(0.0)
        hidden = float(0.0)
        may_be_hidden = c.brake_seen != 0 and m >= instances and m < instances + BRAKING_FAN
        for t in range(thread, start, THREADS):
            term = state_terms[b, m, t]
            if t < steps:
                sums += term
                if may_be_hidden:
                    x = positions[b, m, t + 1]
                    if is_hidden(b, x, position[b], quaternion[b], rows, columns, c, fine_range):
                        hidden += 1.0
            if t < steps or (c.between_steps != 0 and t >= steps + PROBES):
                nearest = wp.min(nearest, term[3] + allowance)
                nearest_standing = wp.min(nearest_standing, standing_clearance[b, m, t])
            elif t < steps + PROBES and term[3] < c.blocked_radius:
                blocked += 1.0
        J_goal = total(sums[0])
        J_col = total(sums[1])
        J_speed = total(sums[2])
        nearest_standing = minimum(nearest_standing)
        nearest = wp.min(minimum(nearest), nearest_standing)
        blocked = total(blocked)
        if total(hidden) > 0.0:
            nearest -= _HIDDEN
            nearest_standing -= _HIDDEN
        if thread == 0:
            costs.goal_cost[b, m] = J_goal
            costs.collision_cost[b, m] = J_col
            end = positions[b, m, steps]
            to_go = blocked_cost(end, waypoints[b, m], goal_position[b], int(blocked), c)
            jump = jump_cost(controls[b, m, 0], command[b], c.q_control_jump)
            J_escape = escape_cost(end, b, escape, c)
            if m == previous_index:
                J_escape *= 1.0 - c.previous_discount
            S2 = J_goal + J_col + J_speed + jump + to_go + J_escape
            costs.stage2_cost[b, m] = S2
            instance_scores[b, m] = wp.vec3(S2, nearest, nearest_standing)

    return tuning.set_options(score_instances)


@functools.cache
def commit_plan(tuning: KernelTuning) -> wp.Kernel:
    """Return the kernel that selects the best instance, with `tuning.threads_per_instance` lanes per drone."""
    LANES = wp.constant(tuning.threads_per_instance)
    select = select_best(tuning)

    @wp.kernel(module="unique", enable_backward=False)
    def commit_plan(
        # problem
        time: wp.array(dtype=wp.float64),
        position: wp.array(dtype=wp.vec3),
        goal_position: wp.array(dtype=wp.vec3),
        cloud_age: wp.array(dtype=float),
        control: wp.array(dtype=wp.vec4),
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        brake_index: int,
        # in
        waypoints: wp.array2d(dtype=wp.vec3),
        standing_clearance: wp.array3d(dtype=float),
        instance_scores: wp.array2d(dtype=wp.vec3),
        plan_period: wp.array(dtype=float),
        stop_ready: wp.array(dtype=int),
        stop_command: wp.array(dtype=wp.vec4),
        stop_controls: wp.array3d(dtype=wp.vec4),
        stop_clearance: wp.array2d(dtype=float),
        # in and out
        guides: GuideSet,
        rollouts: Rollouts,
        costs: InstanceCosts,
        clearance: wp.array3d(dtype=float),
        tick: wp.array(dtype=int),
        escape: Escape,
        # out
        best: wp.array(dtype=int),
        status: wp.array(dtype=int),
        braking_instance: wp.array(dtype=int),
        previous: PreviousPlan,
    ):
        """Select the best instance, replace it by a braking candidate if needed, and keep what the next plan needs.

        Launched over [B, LANES]. The lanes share the time steps; the first one writes what has none.
        """
        b, lane = wp.tid()
        steps = rollouts.controls.shape[2]
        proven = rollouts.controls.shape[1] - 1  # row of the stop that was proven last
        start_clearance = standing_clearance[b, 0, standing_clearance.shape[2] - 1]
        c = params[b]
        m, flown, replaced, outcome, stop = select(
            b, lane, instances, brake_index, start_clearance, cloud_age[b], c, stop_ready[b], instance_scores,
            stop_clearance,
        )  # fmt: skip
        switch = steps
        if replaced < 0:
            switch = switch_step(stop, steps, plan_period[b], c)
        hover = wp.vec4(c.mass * c.gravity, 0.0, 0.0, 0.0)
        for t in range(lane, steps + 1, LANES):
            flown_control = rollouts.controls[b, flown, wp.min(t, steps - 1)]
            if t == 0 and flown == proven:
                # What is flown until the next plan is the stop itself; its rollout has the mean over the time step.
                flown_control = stop_command[b]
            if replaced >= 0:
                guides.positions[b, m, t] = guides.positions[b, flown, t]
                rollouts.positions[b, m, t] = rollouts.positions[b, flown, t]
                rollouts.velocities[b, m, t] = rollouts.velocities[b, flown, t]
                rollouts.quaternions[b, m, t] = rollouts.quaternions[b, flown, t]
            if t < steps:
                previous.controls[b, t] = flown_control
                if replaced >= 0:
                    rollouts.controls[b, m, t] = flown_control
                    clearance[b, m, t] = clearance[b, flown, t]
                if c.prove_stop != 0 and flown != proven:
                    # Keep the controls of the stop, of twice the length of the horizon.
                    for half in range(2):
                        k = t + half * steps
                        kept = hover
                        if k < switch:
                            kept = rollouts.controls[b, flown, k]
                        elif replaced < 0 and k - switch < steps:
                            kept = stop_controls[b, m * STOPS + stop, k - switch]
                        previous.stop[b, k] = kept
        if lane > 0:
            return
        best[b] = m
        status[b] = outcome
        braking_instance[b] = replaced
        if replaced >= 0:
            guides.anchors[b, m] = guides.anchors[b, flown]
            costs.goal_cost[b, m] = costs.goal_cost[b, flown]
            costs.collision_cost[b, m] = costs.collision_cost[b, flown]
            costs.stage2_cost[b, m] = costs.stage2_cost[b, flown]
            for i in range(6):
                guides.coefficients[b, m, i] = guides.coefficients[b, flown, i]
        previous.start_control[b] = control[b]
        if c.prove_stop == 0:
            previous.stop_age[b] = wp.INF
        elif flown == proven:
            previous.stop_age[b] = previous.stop_age[b] + plan_period[b]
        else:
            previous.stop_age[b] = 0.0
        previous.end[b] = rollouts.positions[b, flown, steps]
        waypoint = waypoints[b, flown]
        previous.waypoint[b] = wp.where(waypoint == goal_position[b], wp.vec3(wp.NAN, wp.NAN, wp.NAN), waypoint)
        tick[b] = tick[b] + 1
        if c.q_escape > 0.0:
            remember_place(b, position[b], goal_position[b], plan_period[b], escape, c)
        if not wp.isnan(time[b]):
            previous.time[b] = time[b]
        else:
            before = previous.time[b]
            if wp.isnan(before):
                before = wp.float64(0.0)
            previous.time[b] = before + wp.float64(c.replan_period)

    return tuning.set_options(commit_plan)
