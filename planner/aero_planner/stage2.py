"""Stage II: roll out the optimised controls, pick the best instance, and brake where none is safe.

After the M instances come the ways to brake. One of them takes the place of an instance where braking is what is left.
"""

# No postponed annotations: those of kernels that `width` shapes name local types.

import functools
from typing import Any

import warp as wp

from aero_planner.clearance import above_floor, block_type, cell_size, clearance_at, keep_loops, row_limit
from aero_planner.costs import collision_cost, goal_cost, speed_cost
from aero_planner.dynamics import rk4_step
from aero_planner.mppi import PROBES, blocked_cost, probe
from aero_planner.params import Params

__all__ = ["conclude", "evaluate", "roll_out_best", "score", "select"]

wp.set_module_options({"enable_backward": False})

OK = wp.constant(0)
NO_SAFE_CANDIDATE = wp.constant(1)
STALE_CLOUD = wp.constant(2)


@wp.kernel
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
    BRAKES]."""
    b, m = wp.tid()
    c = params[b]
    p = position[b]
    v = velocity[b]
    q = quaternion[b]
    positions[b, m, 0] = p
    velocities[b, m, 0] = v
    quaternions[b, m, 0] = q
    is_brake = m >= instances
    steps = controls.shape[2]
    u_next = wp.where(is_brake, nominal[b, m, 0], controls[b, m, 0])
    for t in range(steps):
        u = u_next
        # Read ahead, so that a GPU does not wait for memory at every step.
        ahead = wp.min(t + 1, steps - 1)
        u_next = wp.where(is_brake, nominal[b, m, ahead], controls[b, m, ahead])
        controls[b, m, t] = u
        p, v, q = rk4_step(p, v, q, u, c.mass, c.gravity, c.dt)
        positions[b, m, t + 1] = p
        velocities[b, m, t + 1] = v
        quaternions[b, m, t + 1] = q


@functools.cache
def evaluate(width: int, threads: int) -> wp.Kernel:
    """Return the kernel for blocks of `width` points and of `threads` threads."""
    nearest_point = clearance_at(width, threads)
    Block: Any = block_type(width)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        position: wp.array(dtype=wp.vec3),
        goal_position: wp.array(dtype=wp.vec3),
        goal_velocity: wp.array(dtype=wp.vec3),
        goal_quaternion: wp.array(dtype=wp.vec4),
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
        """Costs and clearance of every state of Stage II, and the clearance on the way to the goal and half way between
        the states, in this order.

        `terms` are J_goal, J_col, the speed's cost and the distance to the nearest point. Launched over [B, M + BRAKES,
        N + PROBES + N, threads].
        """
        b, m, t, thread = wp.tid()
        c = params[b]
        steps = positions.shape[2] - 1
        x = positions[b, m, wp.min(t + 1, steps)]
        limit = row_limit(t, steps, c)
        if t >= steps + PROBES:
            half = t - steps - PROBES
            x = 0.5 * (positions[b, m, half] + positions[b, m, half + 1])
            limit = c.safe_clearance
        elif t >= steps:
            x = probe(x, goal_position[b], t - steps, c)
        d = nearest_point(x, limit, b, thread, position[b], cell_size(c), beside, end, blocks)
        d = above_floor(d, x, c)
        J_goal = float(0.0)
        J_speed = float(0.0)
        if t < steps:
            v = velocities[b, m, t + 1]
            q = quaternions[b, m, t + 1]
            J_goal = goal_cost(x, v, q, goal_position[b], goal_velocity[b], goal_quaternion[b], c)
            J_speed = speed_cost(v, c)
            clearance[b, m, t] = wp.min(d, c.distance_max)
        terms[b, m, t] = wp.vec4(J_goal, collision_cost(d, c), J_speed, d)

    return keep_loops(evaluate, width)


@wp.kernel
def score(
    goal_position: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    positions: wp.array3d(dtype=wp.vec3),
    terms: wp.array3d(dtype=wp.vec4),
    J_goal: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    nearest: wp.array2d(dtype=float),
):
    """S2 of each instance, its terms, and how near it comes to a point. Launched over [B, M + BRAKES]."""
    b, m = wp.tid()
    c = params[b]
    steps = positions.shape[2] - 1
    sums = wp.vec4(0.0, 0.0, 0.0, 0.0)
    least = float(wp.INF)
    for t in range(steps):
        term = terms[b, m, t]
        sums += term
        least = wp.min(least, term[3])
    if c.between_steps != 0:
        for t in range(steps + PROBES, terms.shape[2]):
            least = wp.min(least, terms[b, m, t][3])
    blocked = int(0)
    for t in range(steps, steps + PROBES):
        if terms[b, m, t][3] < c.blocked_radius:
            blocked += 1
    to_go = blocked_cost(positions[b, m, steps], goal_position[b], blocked, c)
    J_goal[b, m] = sums[0]
    J_col[b, m] = sums[1]
    S2[b, m] = sums[0] + sums[1] + sums[2] + to_go
    nearest[b, m] = least


@functools.cache
def select(width: int) -> wp.Kernel:
    """Return the kernel for blocks of `width` points."""
    clearance = clearance_at(width, 1)
    Block: Any = block_type(width)

    @wp.kernel(module="unique", enable_backward=False)
    def select(
        instances: int,
        brake_index: int,
        position: wp.array(dtype=wp.vec3),
        params: wp.array(dtype=Params),
        cloud_age: wp.array(dtype=float),
        beside: int,
        end: wp.array2d(dtype=int),
        blocks: wp.array2d(dtype=Block),
        S2: wp.array2d(dtype=float),
        nearest: wp.array2d(dtype=float),
        flown: wp.array(dtype=int),
        best: wp.array(dtype=int),
        status: wp.array(dtype=int),
        braked: wp.array(dtype=int),
    ):
        """The instance with the least S2, by `prefer_safe` among the safe ones where there are any. Launched over [B].

        An instance is safe when it stays `safe_clearance` away from every point, or, for a drone that is nearer
        already, when it does not come nearer still. Where the status is not OK, `braked` is the instance whose place
        the farthest way to brake takes: the braking candidate, or the chosen one where there is none; else it is -1.
        `flown` is what is flown, before that replacement.
        """
        b = wp.tid()
        c = params[b]
        here = clearance(position[b], c.safe_clearance, b, 0, position[b], cell_size(c), beside, end, blocks)
        here = above_floor(here, position[b], c)
        safe = c.safe_clearance
        if here < safe:
            safe = here - 0.02
        chosen = int(0)
        chosen_safe = nearest[b, 0] >= safe
        for m in range(1, instances):
            is_safe = nearest[b, m] >= safe
            better = S2[b, m] < S2[b, chosen]
            if c.prefer_safe != 0 and is_safe != chosen_safe:
                better = is_safe
            if better:
                chosen = m
                chosen_safe = is_safe
        outcome = wp.where(chosen_safe, OK, NO_SAFE_CANDIDATE)
        if cloud_age[b] > c.cloud_age_max:
            outcome = STALE_CLOUD
        replaced = int(-1)
        if outcome != OK:
            replaced = wp.where(brake_index >= 0, brake_index, chosen)
            chosen = replaced
            source = instances
            for way in range(instances + 1, S2.shape[1]):
                if nearest[b, way] > nearest[b, source]:
                    source = way
            flown[b] = source
        else:
            flown[b] = chosen
        best[b] = chosen
        status[b] = outcome
        braked[b] = replaced

    return keep_loops(select, width)


@wp.kernel
def conclude(
    time: wp.array(dtype=wp.float64),
    params: wp.array(dtype=Params),
    flown: wp.array(dtype=int),
    best: wp.array(dtype=int),
    braked: wp.array(dtype=int),
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
    tick: wp.array(dtype=int),
    previous_controls: wp.array2d(dtype=wp.vec4),
    previous_end: wp.array(dtype=wp.vec3),
    previous_time: wp.array(dtype=wp.float64),
):
    """Put the way to brake in its place where it is needed, and keep what the next plan starts from.

    That is the controls to fly, the end they lead to, and the time. Launched over [B, N + 1].
    """
    b, t = wp.tid()
    steps = controls.shape[2]
    m = best[b]
    source = flown[b]
    if braked[b] >= 0:
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
        tick[b] = tick[b] + 1
        if not wp.isnan(time[b]):
            previous_time[b] = time[b]
        else:
            before = previous_time[b]
            if wp.isnan(before):
                before = wp.float64(0.0)
            previous_time[b] = before + wp.float64(params[b].replan_period)
