"""Stage II: roll out the optimised controls, sum S2, and select.

The M instances are followed by the candidates that stop: the braking candidates, and those that stages append. The
selection is three functions: `rank` orders the instances, `admissible` says which of them may be flown, and `fallback`
says what is flown if none may.
"""

# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import warp as wp

from aero_planner.composition import Composition
from aero_planner.costs.cost_term import End, Step
from aero_planner.device.hook_records import Fallback
from aero_planner.device.kernel_tuning import KernelTuning
from aero_planner.device.params import Params
from aero_planner.device.records import Choice, PreviousPlan, Problem, Rollouts, Scores, Start, grid_struct
from aero_planner.device.warp_ops import minimum_over, read_lane, read_lane_integer, sum_over
from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at, query_limit
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.mppi import PROBES, probe_position
from aero_planner.kernels.prediction import UNSTAMPED_PERIOD, time_since_plan
from aero_planner.plan import PlanStatus

wp.set_module_options({"enable_backward": False})

OK = wp.constant(int(PlanStatus.OK))
NO_SAFE_CANDIDATE = wp.constant(int(PlanStatus.NO_SAFE_CANDIDATE))
STALE_CLOUD = wp.constant(int(PlanStatus.STALE_CLOUD))


@functools.cache
def roll_out_controls(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel of the Stage II rollouts, with `tuning.threads_per_instance` threads per instance."""
    LANES = wp.constant(tuning.threads_per_instance)
    constants, step = composition.model.constants, composition.model.step

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out_controls(
        # problem
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        # in
        nominal_controls: wp.array3d(dtype=wp.vec4),
        # in (controls of the instances) and out
        rollouts: Rollouts,
    ):
        """Roll out the optimised controls of the instances and the nominal controls of the other rows.

        Launched over [B, R, LANES]. The lanes read the controls of as many time steps at once.
        """
        b, m, lane = wp.tid()
        c = params[b]
        p = start.position[b]
        v = start.velocity[b]
        q = start.quaternion[b]
        if lane == 0:
            rollouts.positions[b, m, 0] = p
            rollouts.velocities[b, m, 0] = v
            rollouts.quaternions[b, m, 0] = q
        acting = start.control[b]
        k = constants(start.disturbance[b], start.drag[b], c.dt, c)
        steps = rollouts.controls.shape[2]
        for first in range(0, steps, LANES):
            t_lane = wp.min(first + lane, steps - 1)
            u_lane = wp.where(m < instances, rollouts.controls[b, m, t_lane], nominal_controls[b, m, t_lane])
            rollouts.controls[b, m, t_lane] = u_lane
            for t in range(first, wp.min(first + LANES, steps)):
                i = t - first
                u = wp.vec4(
                    read_lane(u_lane[0], i), read_lane(u_lane[1], i), read_lane(u_lane[2], i), read_lane(u_lane[3], i)
                )  # fmt: skip
                p, v, q, acting = step(p, v, q, acting, u, k)
                if lane == 0:
                    rollouts.positions[b, m, t + 1] = p
                    rollouts.velocities[b, m, t + 1] = v
                    rollouts.quaternions[b, m, t + 1] = q

    return tuning.set_options(roll_out_controls)


@wp.func
def step_of_rollout(
    b: int, m: int, t: int, previous_index: int, problem: Problem, start: Start,
    guides: wp.array3d(dtype=wp.vec3), rollouts: Rollouts,
) -> Step:  # fmt: skip
    """Return a time step of a Stage II rollout as the cost terms see it."""
    s = Step()
    s.t = t
    s.last = rollouts.controls.shape[2] - 1
    s.is_guided = wp.where(m == previous_index, 0, 1)
    s.p = rollouts.positions[b, m, t + 1]
    s.v = rollouts.velocities[b, m, t + 1]
    s.q = rollouts.quaternions[b, m, t + 1]
    s.u = rollouts.controls[b, m, t]
    s.u_before = start.command[b]
    if t > 0:
        s.u_before = rollouts.controls[b, m, t - 1]
    s.p_guide = guides[b, m, t + 1]
    s.p_goal = problem.goal[b]
    s.v_goal = start.goal_velocity[b]
    s.q_goal = start.goal_quaternion[b]
    return s


@functools.cache
def evaluate_states(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that evaluates Stage II states, with `tuning.threads_per_query` threads per position."""
    clearance_of = clearance_at(tuning.points_per_pack, tuning.threads_per_query)
    Grid: Any = grid_struct(tuning.points_per_pack)
    Views, dynamic = composition.Views, composition.hooks.clearance
    goal_cost, other_cost, obstacle_cost = composition.goal, composition.running2, composition.obstacle

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_states(
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        previous_index: int,
        # in
        grid: Grid,
        views: Views,
        guides: wp.array3d(dtype=wp.vec3),
        rollouts: Rollouts,
        # out
        state_costs: wp.array3d(dtype=wp.vec3),
        scores: Scores,
    ):
        """Evaluate costs and clearance of the N states, the PROBES of the cost-to-go, and the start, in this order.

        `state_costs` are J_goal, J_col and the other terms of S2. Launched over [B, R, N + PROBES + 1, threads per
        query].
        """
        b, m, t, thread = wp.tid()
        if problem.active[b] == 0:
            return
        c = params[b]
        steps = rollouts.controls.shape[2]
        v = problem.velocity[b]
        x = rollouts.positions[b, m, wp.min(t + 1, steps)]
        time = float(t + 1) * c.dt
        margin = float(0.0)
        limit = query_limit(t, steps, v, c)
        if t == steps + PROBES:
            x = rollouts.positions[b, m, 0]
            time = 0.0
            limit = query_limit(0, steps, v, c)
        elif t >= steps:
            x = probe_position(x, problem.goal[b], t - steps, c)
        d = clearance_of(x, limit, b, thread, problem.position[b], cell_size(v, c), grid)
        d = above_ground(d, x, problem.ground_height[b], c)
        static_d = d
        if t < steps or t == steps + PROBES:
            d = dynamic(d, x, time, b, views, c)
        if t < steps:
            s = step_of_rollout(b, m, t, previous_index, problem, start, guides, rollouts)
            state_costs[b, m, t] = wp.vec3(goal_cost(s, c), obstacle_cost(d, c), other_cost(s, c))
            margin = c.speed_margin * wp.length(s.v)
            scores.clearance[b, m, t] = wp.min(d, c.distance_max)
        scores.state_clearance[b, m, t] = d - margin
        scores.static_clearance[b, m, t] = static_d - margin

    return tuning.set_options(evaluate_states, keep_loops=True)


@wp.func
def safe_clearance(start_clearance: float, c: Params) -> float:
    """Return the clearance that is demanded of an instance [m].

    For a drone that is nearer than safe_clearance at the start, it is safe not to come nearer still.
    """
    return wp.where(start_clearance < c.safe_clearance, start_clearance - 0.02, c.safe_clearance)


@wp.func
def dynamic_allowance(b: int, m: int, scores: Scores, c: Params) -> float:
    """Return how much nearer than static obstacles dynamic ones may come to a safe instance [m].

    It is 0 unless a dynamic obstacle is near at the start.
    """
    start = scores.state_clearance.shape[2] - 1
    static_safe = safe_clearance(scores.static_clearance[b, m, start], c)
    return static_safe - safe_clearance(scores.state_clearance[b, m, start], c)


@functools.cache
def score_instances(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that sums S2, with `tuning.threads_per_instance` threads per instance."""
    THREADS = wp.constant(tuning.threads_per_instance)
    minimum, total = minimum_over(tuning.threads_per_instance), sum_over(tuning.threads_per_instance)
    Views, terminal_cost = composition.Views, composition.terminal2

    @wp.kernel(module="unique", enable_backward=False)
    def score_instances(
        # problem
        problem: Problem,
        # configuration
        params: wp.array(dtype=Params),
        # in
        views: Views,
        positions: wp.array3d(dtype=wp.vec3),
        state_costs: wp.array3d(dtype=wp.vec3),
        # in (clearances of the states) and out
        scores: Scores,
    ):
        """Sum S2 of each row and its terms, and find its least clearances. Launched over [B, R, THREADS]."""
        b, m, thread = wp.tid()
        c = params[b]
        steps = positions.shape[2] - 1
        allowance = dynamic_allowance(b, m, scores, c)
        sums = wp.vec3(0.0, 0.0, 0.0)
        nearest = float(wp.INF)
        nearest_static = float(wp.INF)
        blocked = float(0.0)
        for t in range(thread, steps + PROBES, THREADS):
            if t < steps:
                sums += state_costs[b, m, t]
                nearest = wp.min(nearest, scores.state_clearance[b, m, t] + allowance)
                nearest_static = wp.min(nearest_static, scores.static_clearance[b, m, t])
            elif scores.state_clearance[b, m, t] < c.distance_min:
                blocked += 1.0
        J_goal = total(sums[0])
        J_col = total(sums[1])
        others = total(sums[2])
        nearest_static = minimum(nearest_static)
        nearest = wp.min(minimum(nearest), nearest_static)
        blocked = total(blocked)
        if thread == 0:
            e = End()
            e.b = b
            e.p = positions[b, m, steps]
            e.p_goal = problem.goal[b]
            e.blocked = blocked / float(PROBES)
            scores.goal_cost[b, m] = J_goal
            scores.collision_cost[b, m] = J_col
            scores.stage2_cost[b, m] = J_goal + J_col + others + terminal_cost(e, views, c)
            scores.least_clearance[b, m] = wp.vec2(nearest, nearest_static)

    return tuning.set_options(score_instances)


@wp.func
def rank(cost: float, is_admissible: int, best_cost: float, best_admissible: int, c: Params) -> bool:
    """Return True if an instance ranks before the best one so far: by S2, with prefer_safe after being admissible."""
    if c.prefer_safe != 0 and is_admissible != best_admissible:
        return is_admissible != 0
    return cost < best_cost


@functools.cache
def admissible(composition: Composition) -> wp.Function:
    """Return the function that says whether an instance may be flown."""
    Views, judge = composition.Views, composition.hooks.admissible

    @wp.func
    def admissible(b: int, m: int, safe: float, scores: Scores, views: Views, c: Params) -> int:
        """Return 1 if instance m keeps the clearance `safe` [m], unless a stage judges otherwise, else 0."""
        return judge(b, m, wp.where(scores.least_clearance[b, m][0] >= safe, 1, 0), views, c)

    return admissible


@functools.cache
def fallback(composition: Composition) -> wp.Function:
    """Return the function that says what is flown if no instance may be."""
    Views, revise = composition.Views, composition.hooks.fallback

    @wp.func
    def fallback(
        b: int, instances: int, status: int, clear_stop: float, scores: Scores, views: Views, c: Params
    ) -> int:
        """Return the row that is flown: the braking candidate with the largest clearance.

        Those that are clear of static obstacles come first: what seems to move may be an error. Stages may choose
        another row, also an instance.
        """
        f = Fallback()
        f.status = status
        f.flown = instances
        f.clearance = scores.least_clearance[b, instances]
        for k in range(1, BRAKING_FAN):
            d = scores.least_clearance[b, instances + k]
            better = d[0] > f.clearance[0]
            if (d[1] >= clear_stop) != (f.clearance[1] >= clear_stop):
                better = d[1] >= clear_stop
            if better:
                f.flown = instances + k
                f.clearance = d
        f = revise(b, f, views, c)
        return f.flown

    return fallback


@functools.cache
def commit_plan(tuning: KernelTuning, composition: Composition) -> wp.Kernel:
    """Return the kernel that selects, with `tuning.threads_per_instance` lanes per drone."""
    LANES = wp.constant(tuning.threads_per_instance)
    Views, is_admissible, fall_back = composition.Views, admissible(composition), fallback(composition)

    @wp.kernel(module="unique", enable_backward=False)
    def commit_plan(
        # problem
        problem: Problem,
        start: Start,
        # configuration
        params: wp.array(dtype=Params),
        instances: int,
        # in
        views: Views,
        # in and out
        rollouts: Rollouts,
        scores: Scores,
        # out
        choice: Choice,
        previous: PreviousPlan,
    ):
        """Select the best instance, replace it by a candidate that stops if needed, and keep what the next plan needs.

        Launched over [B, LANES]. Every lane judges an instance of its own; then all of them compare the instances in
        order. The lanes share the time steps; the first one writes what has none.
        """
        b, lane = wp.tid()
        steps = rollouts.controls.shape[2]
        c = params[b]
        start_clearance = scores.static_clearance[b, 0, scores.static_clearance.shape[2] - 1]
        safe = safe_clearance(start_clearance, c)
        m = int(0)
        lowest = float(wp.INF)
        best_admissible = int(0)
        for first in range(0, instances, LANES):
            m_lane = wp.min(first + lane, instances - 1)
            cost_lane = scores.stage2_cost[b, m_lane]
            admissible_lane = is_admissible(b, m_lane, safe, scores, views, c)
            for j in range(wp.min(LANES, instances - first)):
                cost = read_lane(cost_lane, j)
                admitted = read_lane_integer(admissible_lane, j)
                if first + j == 0 or rank(cost, admitted, lowest, best_admissible, c):
                    m = first + j
                    lowest = cost
                    best_admissible = admitted
        status = wp.where(best_admissible != 0, OK, NO_SAFE_CANDIDATE)
        blind_time = float(0.0)
        if problem.is_blind[b] != 0:
            since = time_since_plan(b, problem.time[b], previous, c)
            blind_time = previous.blind_time[b] + wp.where(since > 0.0, since, 0.0)  # NaN before the first plan
        if wp.max(problem.cloud_age[b], blind_time) > c.cloud_age_max:
            status = STALE_CLOUD
        flown = m
        if status != OK:
            flown = fall_back(b, instances, status, safe, scores, views, c)
            m = wp.where(flown < instances, flown, m)
        for t in range(lane, steps + 1, LANES):
            if flown != m:
                rollouts.positions[b, m, t] = rollouts.positions[b, flown, t]
                rollouts.velocities[b, m, t] = rollouts.velocities[b, flown, t]
                rollouts.quaternions[b, m, t] = rollouts.quaternions[b, flown, t]
            if t < steps:
                u = rollouts.controls[b, flown, t]
                previous.controls[b, t] = u
                if flown != m:
                    rollouts.controls[b, m, t] = u
                    scores.clearance[b, m, t] = scores.clearance[b, flown, t]
        if lane > 0:
            return
        choice.best[b] = m
        choice.status[b] = status
        choice.flown[b] = flown
        choice.replaced[b] = wp.where(flown != m, m, -1)
        if flown != m:
            scores.goal_cost[b, m] = scores.goal_cost[b, flown]
            scores.collision_cost[b, m] = scores.collision_cost[b, flown]
            scores.stage2_cost[b, m] = scores.stage2_cost[b, flown]
        previous.start_control[b] = start.control[b]
        previous.end[b] = rollouts.positions[b, flown, steps]
        previous.tick[b] = previous.tick[b] + 1
        previous.blind_time[b] = blind_time
        if not wp.isnan(problem.time[b]):
            previous.time[b] = problem.time[b]
        else:
            before = previous.time[b]
            if wp.isnan(before):
                before = wp.float64(0.0)
            previous.time[b] = before + wp.float64(UNSTAMPED_PERIOD)

    return tuning.set_options(commit_plan)
