"""Stage II: rollouts of the optimised controls, selection, braking. The braking candidates follow the M instances."""

from __future__ import annotations

import warp as wp

from benchmarks.naive.arrays import BRAKING_CANDIDATES, Arrays
from benchmarks.naive.guides import follow_guide, turned, write_guide
from benchmarks.naive.model import PROBES, follow_command, goal_cost, jump_cost, probe_position, rk4, speed_cost, yaw
from benchmarks.naive.mppi import collision_and_blocked, distance_to

wp.set_module_options({"enable_backward": False})


@wp.kernel
def braking_candidates(a: Arrays):
    """Write guides and controls that brake straight ahead, left, right, farther left and farther right over [B].

    They stop within brake_reach v T.
    """
    b = wp.tid()
    c = a.params[b]
    T = float(a.nominal.shape[2]) * c.dt
    for candidate in range(BRAKING_CANDIDATES):
        row = a.nominal.shape[1] + candidate
        angle = float((candidate + 1) // 2) * wp.radians(c.brake_fan)
        if candidate % 2 == 0:
            angle = -angle
        a.anchor[b, row] = a.position[b] + c.brake_reach * T * turned(a.velocity[b], angle)
        a.waypoint[b, row] = a.goal_position[b]
        write_guide(a, b, row, a.anchor[b, row], wp.vec3(0.0, 0.0, 0.0), c.dt)
        follow_guide(a, b, row, yaw(a.q0[b]), 0.0, a.controls)


@wp.kernel
def final_rollouts(a: Arrays):
    """Roll out the optimised controls and the braking candidates. Launched over [B R]."""
    i = wp.tid()
    b = i // a.controls.shape[1]
    m = i % a.controls.shape[1]
    c = a.params[b]
    N = a.controls.shape[2]
    p = a.position[b]
    v = a.velocity[b]
    q = a.q0[b]
    control = a.control[b]
    a.states[b, m, 0] = p
    goal = float(0.0)
    speed = float(0.0)
    for t in range(N):
        mean, control = follow_command(control, a.controls[b, m, t], c.dt, c)
        p, v, q = rk4(p, v, q, mean, c)
        a.states[b, m, t + 1] = p
        a.positions[i, 0, t] = p
        a.positions[i, 0, N + PROBES + t] = 0.5 * (a.states[b, m, t] + p)
        goal += goal_cost(p, v, q, a.goal_position[b], a.v_goal[b], a.q_goal[b], c)
        speed += speed_cost(v, c)
    for j in range(PROBES):
        a.positions[i, 0, N + j] = probe_position(p, a.waypoint[b, m], a.goal_position[b], j, c)
    a.J_goal[b, m] = goal
    a.J_speed[b, m] = speed


@wp.kernel
def final_scores(a: Arrays):
    """Sum S2 and find the minimum clearance of every row. Launched over [B R]."""
    i = wp.tid()
    b = i // a.controls.shape[1]
    m = i % a.controls.shape[1]
    c = a.params[b]
    N = a.controls.shape[2]
    least = float(1.0e9)
    for t in range(N):
        least = wp.min(least, a.distance[i, 0, t])
        if c.between_steps != 0:
            least = wp.min(least, a.distance[i, 0, N + PROBES + t])
    a.nearest[b, m] = least
    collision, to_go = collision_and_blocked(i, 0, N, a.waypoint[b, m], a.goal_position[b], c, a.positions, a.distance)
    a.J_col[b, m] = collision
    jump = jump_cost(a.controls[b, m, 0], a.command[b], c)
    a.S2[b, m] = a.J_goal[b, m] + collision + to_go + a.J_speed[b, m] + jump


@wp.kernel
def select(a: Arrays):
    """Select the lowest S2, with prefer_safe among the safe instances; brake if it is not safe. Launched over [B].

    status: 0 OK, 1 none safe, 2 cloud too old. `source` is the row whose controls are flown. Of the braking candidates
    it is the one with the largest clearance, and the first of several equal ones.
    """
    b = wp.tid()
    c = a.params[b]
    M = a.nominal.shape[1]
    safe = c.safe_clearance
    start_distance = distance_to(a.position[b], safe, b, a)
    if start_distance < safe:  # too near already: do not come nearer
        safe = start_distance - 0.02
    chosen = int(0)
    for m in range(1, M):
        better = a.S2[b, m] < a.S2[b, chosen]
        if c.prefer_safe != 0 and (a.nearest[b, m] >= safe) != (a.nearest[b, chosen] >= safe):
            better = a.nearest[b, m] >= safe
        if better:
            chosen = m
    a.status[b] = 0
    if a.nearest[b, chosen] < safe:
        a.status[b] = 1
    if a.cloud_age[b] > c.cloud_age_max:
        a.status[b] = 2
    a.source[b] = chosen
    if a.status[b] != 0:
        a.source[b] = M
        for row in range(M + 1, M + BRAKING_CANDIDATES):
            if a.nearest[b, row] > a.nearest[b, a.source[b]]:
                a.source[b] = row
        if a.brake_index >= 0:
            chosen = a.brake_index
    a.best[b] = chosen


@wp.kernel
def commit(a: Arrays):
    """Replace the selected instance by the row that is flown. Launched over [B]."""
    b = wp.tid()
    m = a.best[b]
    n = a.source[b]
    a.anchor[b, m] = a.anchor[b, n]
    a.J_goal[b, m] = a.J_goal[b, n]
    a.J_col[b, m] = a.J_col[b, n]
    a.S2[b, m] = a.S2[b, n]
    for t in range(a.controls.shape[2]):
        a.controls[b, m, t] = a.controls[b, n, t]
    for t in range(a.controls.shape[2] + 1):
        a.guide[b, m, t] = a.guide[b, n, t]
        a.states[b, m, t] = a.states[b, n, t]
