"""Stage II: roll out the optimised controls, pick the best instance, and brake where none is safe.

After the M instances come the ways to brake. One of them takes the place of an instance where braking is what is left.
"""

# No postponed annotations: those of kernels that `width` shapes name local types.

import functools
from typing import Any

import warp as wp

from aero_planner.kernels.clearance import above_ground, cell_size, clearance_at, row_limit
from aero_planner.kernels.costs import collision_cost, goal_cost, speed_cost
from aero_planner.kernels.dynamics import rk4_step
from aero_planner.kernels.kernel_tuning import Widths, block_type, least_of, of_thread, sum_of
from aero_planner.kernels.mppi import PROBES, blocked_cost, probe
from aero_planner.kernels.params import Params

__all__ = ["conclude", "evaluate", "roll_out_best", "score"]

wp.set_module_options({"enable_backward": False})

OK = wp.constant(0)
NO_SAFE_CANDIDATE = wp.constant(1)
STALE_CLOUD = wp.constant(2)


@functools.cache
def roll_out_best(of: Widths) -> wp.Kernel:
    """Return the kernel with `of.steps` threads for an instance."""
    LANES = wp.constant(of.steps)

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out_best(
        instances: int,
        position: wp.array(dtype=wp.vec3),
        velocity: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.vec4),
        params: wp.array(dtype=Params),
        nominal: wp.array3d(dtype=wp.vec4),
        controls: wp.array3d(dtype=wp.vec4),
        positions: wp.array3d(dtype=wp.vec3),
        velocities: wp.array3d(dtype=wp.vec3),
        quaternions: wp.array3d(dtype=wp.vec4),
    ):
        """Stage II rollouts of the optimised controls; of the ways to brake, the nominal ones. Launched over [B, M +
        BRAKES, of.steps], which read the controls of as many steps at once."""
        b, m, lane = wp.tid()
        c = params[b]
        p = position[b]
        v = velocity[b]
        q = quaternion[b]
        if lane == 0:
            positions[b, m, 0] = p
            velocities[b, m, 0] = v
            quaternions[b, m, 0] = q
        steps = controls.shape[2]
        for first in range(0, steps, LANES):
            mine = wp.min(first + lane, steps - 1)
            u_mine = wp.where(m < instances, controls[b, m, mine], nominal[b, m, mine])
            controls[b, m, mine] = u_mine
            for t in range(first, wp.min(first + LANES, steps)):
                step = t - first
                u = wp.vec4(
                    of_thread(u_mine[0], step), of_thread(u_mine[1], step),
                    of_thread(u_mine[2], step), of_thread(u_mine[3], step),
                )  # fmt: skip
                p, v, q = rk4_step(p, v, q, u, c.mass, c.gravity, c.dt)
                if lane == 0:
                    positions[b, m, t + 1] = p
                    velocities[b, m, t + 1] = v
                    quaternions[b, m, t + 1] = q

    return of.tune(roll_out_best)


@functools.cache
def evaluate(of: Widths) -> wp.Kernel:
    """Return the kernel with a team of `of.team` threads for each position."""
    nearest_point = clearance_at(of.points, of.team)
    Block: Any = block_type(of.points)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        position: wp.array(dtype=wp.vec3),
        ground_height: wp.array(dtype=float),
        goal_position: wp.array(dtype=wp.vec3),
        goal_velocity: wp.array(dtype=wp.vec3),
        goal_quaternion: wp.array(dtype=wp.vec4),
        turn: wp.array2d(dtype=wp.vec3),
        params: wp.array(dtype=Params),
        beside: int,
        end: wp.array2d(dtype=int),
        blocks: wp.array2d(dtype=Block),
        positions: wp.array3d(dtype=wp.vec3),
        velocities: wp.array3d(dtype=wp.vec3),
        quaternions: wp.array3d(dtype=wp.vec4),
        clearance: wp.array3d(dtype=float),
        terms: wp.array3d(dtype=wp.vec4),
    ):
        """Costs and clearance of every state of Stage II, and the clearance on the way to the goal, half way between
        the states, and at the start, in this order.

        `terms` are J_goal, J_col, the speed's cost and the distance to the nearest point. Launched over [B, M + BRAKES,
        N + PROBES + N + 1, of.team].
        """
        b, m, t, thread = wp.tid()
        c = params[b]
        steps = positions.shape[2] - 1
        x = positions[b, m, wp.min(t + 1, steps)]
        limit = row_limit(t, steps, c)
        if t >= steps + PROBES:
            # The last is half way from the start to the start.
            half = (t - steps - PROBES) % steps
            x = 0.5 * (positions[b, m, half] + positions[b, m, wp.where(t == terms.shape[2] - 1, half, half + 1)])
            limit = c.safe_clearance
        elif t >= steps:
            x = probe(x, turn[b, m], goal_position[b], t - steps, c)
        d = nearest_point(x, limit, b, thread, position[b], cell_size(c), beside, end, blocks)
        d = above_ground(d, x, ground_height[b], c)
        J_goal = float(0.0)
        J_speed = float(0.0)
        if t < steps:
            v = velocities[b, m, t + 1]
            q = quaternions[b, m, t + 1]
            J_goal = goal_cost(x, v, q, goal_position[b], goal_velocity[b], goal_quaternion[b], c)
            J_speed = speed_cost(v, c)
            clearance[b, m, t] = wp.min(d, c.distance_max)
        terms[b, m, t] = wp.vec4(J_goal, collision_cost(d, c), J_speed, d)

    return of.tune(evaluate, keep_loops=True)


@functools.cache
def score(of: Widths) -> wp.Kernel:
    """Return the kernel with `of.steps` threads for the terms of an instance."""
    THREADS = wp.constant(of.steps)
    least_of_all, sum_of_all = least_of(of.steps), sum_of(of.steps)

    @wp.kernel(module="unique", enable_backward=False)
    def score(
        goal_position: wp.array(dtype=wp.vec3),
        turn: wp.array2d(dtype=wp.vec3),
        params: wp.array(dtype=Params),
        positions: wp.array3d(dtype=wp.vec3),
        terms: wp.array3d(dtype=wp.vec4),
        J_goal: wp.array2d(dtype=float),
        J_col: wp.array2d(dtype=float),
        S2: wp.array2d(dtype=float),
        scores: wp.array2d(dtype=wp.vec2),
    ):
        """S2 of each instance and its terms; `scores` are S2 and how near it comes to a point [m].

        Launched over [B, M + BRAKES, of.steps].
        """
        b, m, thread = wp.tid()
        c = params[b]
        steps = positions.shape[2] - 1
        sums = wp.vec4(0.0, 0.0, 0.0, 0.0)
        least = float(wp.INF)
        blocked = float(0.0)
        for t in range(thread, terms.shape[2] - 1, THREADS):
            term = terms[b, m, t]
            if t < steps:
                sums += term
            if t < steps or (c.between_steps != 0 and t >= steps + PROBES):
                least = wp.min(least, term[3])
            elif t < steps + PROBES and term[3] < c.blocked_radius:
                blocked += 1.0
        goal = sum_of_all(sums[0])
        col = sum_of_all(sums[1])
        speed = sum_of_all(sums[2])
        least = least_of_all(least)
        blocked = sum_of_all(blocked)
        if thread == 0:
            J_goal[b, m] = goal
            J_col[b, m] = col
            end = positions[b, m, steps]
            total = goal + col + speed + blocked_cost(end, turn[b, m], goal_position[b], int(blocked), c)
            S2[b, m] = total
            scores[b, m] = wp.vec2(total, least)

    return of.tune(score)


@wp.func
def choose(
    b: int, instances: int, brake_index: int, here: float, age: float, c: Params, scores: wp.array2d(dtype=wp.vec2)
):
    """The instance with the least S2, by `prefer_safe` among the safe ones where there are any: its index, what is
    flown, the instance that is replaced, and the status.

    An instance is safe when it stays `safe_clearance` away from every point, or, for a drone that is nearer already,
    when it does not come nearer still. Where the status is not OK, what is flown is the farthest way to brake, and it
    takes the place of the braking candidate, or of the chosen instance where there is none; else nothing, -1, is
    replaced.
    """
    safe = c.safe_clearance
    if here < safe:
        safe = here - 0.02
    best = int(0)
    least = scores[b, 0][0]
    best_safe = scores[b, 0][1] >= safe
    for m in range(1, instances):
        score = scores[b, m]
        is_safe = score[1] >= safe
        better = score[0] < least
        if c.prefer_safe != 0 and is_safe != best_safe:
            better = is_safe
        if better:
            best = m
            least = score[0]
            best_safe = is_safe
    flown = best
    replaced = int(-1)
    status = wp.where(best_safe, OK, NO_SAFE_CANDIDATE)
    if age > c.cloud_age_max:
        status = STALE_CLOUD
    if status != OK:
        best = wp.where(brake_index >= 0, brake_index, best)
        replaced = best
        flown = instances
        farthest = scores[b, instances][1]
        for way in range(instances + 1, scores.shape[1]):
            d = scores[b, way][1]
            if d > farthest:
                flown = way
                farthest = d
    return best, flown, replaced, status


@wp.kernel
def conclude(
    instances: int,
    brake_index: int,
    time: wp.array(dtype=wp.float64),
    params: wp.array(dtype=Params),
    cloud_age: wp.array(dtype=float),
    goal_position: wp.array(dtype=wp.vec3),
    turn: wp.array2d(dtype=wp.vec3),
    terms: wp.array3d(dtype=wp.vec4),
    scores: wp.array2d(dtype=wp.vec2),
    anchor: wp.array2d(dtype=wp.vec3),
    coefficient: wp.array3d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
    controls: wp.array3d(dtype=wp.vec4),
    positions: wp.array3d(dtype=wp.vec3),
    velocities: wp.array3d(dtype=wp.vec3),
    quaternions: wp.array3d(dtype=wp.vec4),
    J_goal: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    clearance: wp.array3d(dtype=float),
    best: wp.array(dtype=int),
    status: wp.array(dtype=int),
    braked: wp.array(dtype=int),
    tick: wp.array(dtype=int),
    previous_controls: wp.array2d(dtype=wp.vec4),
    previous_end: wp.array(dtype=wp.vec3),
    previous_turn: wp.array(dtype=wp.vec3),
    previous_time: wp.array(dtype=wp.float64),
):
    """Choose, put the way to brake in its place where it is needed, and keep what the next plan starts from.

    That is the controls to fly, the end they lead to, and the time. Launched over [B, N + 1]; every step chooses by
    itself, the first one tells.
    """
    b, t = wp.tid()
    steps = controls.shape[2]
    here = terms[b, 0, terms.shape[2] - 1][3]
    m, source, replaced, outcome = choose(b, instances, brake_index, here, cloud_age[b], params[b], scores)
    if t == 0:
        best[b] = m
        status[b] = outcome
        braked[b] = replaced
    if replaced >= 0:
        guide[b, m, t] = guide[b, source, t]
        positions[b, m, t] = positions[b, source, t]
        velocities[b, m, t] = velocities[b, source, t]
        quaternions[b, m, t] = quaternions[b, source, t]
        if t < steps:
            controls[b, m, t] = controls[b, source, t]
            clearance[b, m, t] = clearance[b, source, t]
        if t == 0:
            anchor[b, m] = anchor[b, source]
            J_goal[b, m] = J_goal[b, source]
            J_col[b, m] = J_col[b, source]
            S2[b, m] = S2[b, source]
            for i in range(6):
                coefficient[b, m, i] = coefficient[b, source, i]
    if t < steps:
        previous_controls[b, t] = controls[b, source, t]
    else:
        previous_end[b] = positions[b, source, t]
        previous_turn[b] = wp.where(
            turn[b, source] == goal_position[b], wp.vec3(wp.NAN, wp.NAN, wp.NAN), turn[b, source]
        )
        tick[b] = tick[b] + 1
        if not wp.isnan(time[b]):
            previous_time[b] = time[b]
        else:
            before = previous_time[b]
            if wp.isnan(before):
                before = wp.float64(0.0)
            previous_time[b] = before + wp.float64(params[b].replan_period)
