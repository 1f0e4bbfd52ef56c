"""Stage II: rollouts of the optimised controls, selection, braking.

Instance i = b (M + BRAKING_CANDIDATES) + m is instance m of drone b; the braking candidates
follow the M instances.
"""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.params import Params
from benchmarks.naive.guides import BRAKING_CANDIDATES, write_brake
from benchmarks.naive.model import PROBES, goal_cost, probe_position, rk4, speed_cost
from benchmarks.naive.mppi import collision_and_blocked, distance_to

__all__ = ["braking_candidates", "commit", "final_rollouts", "final_scores", "select"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def braking_candidates(
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    acceleration: wp.array(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    anchor: wp.array2d(dtype=wp.vec3),
    coefficient: wp.array3d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
    goal_position: wp.array(dtype=wp.vec3),
    waypoint: wp.array2d(dtype=wp.vec3),
    controls: wp.array3d(dtype=wp.vec4),
):
    """Write the controls that brake straight ahead, left, right, farther left and farther right. Launched over [B]."""
    b = wp.tid()
    M = controls.shape[1] - BRAKING_CANDIDATES
    for candidate in range(BRAKING_CANDIDATES):
        angle = float((candidate + 1) // 2) * wp.radians(params[b].brake_fan)
        if candidate % 2 == 0:
            angle = -angle
        waypoint[b, M + candidate] = goal_position[b]
        write_brake(b, M + candidate, angle, position[b], velocity[b], acceleration[b], quaternion[b], params[b],
                    anchor, coefficient, guide, controls)  # fmt: skip


@wp.kernel
def final_rollouts(
    instances: int,
    position: wp.array(dtype=wp.vec3),
    velocity: wp.array(dtype=wp.vec3),
    quaternion: wp.array(dtype=wp.vec4),
    goal_position: wp.array(dtype=wp.vec3),
    goal_velocity: wp.array(dtype=wp.vec3),
    goal_quaternion: wp.array(dtype=wp.vec4),
    params: wp.array(dtype=Params),
    waypoint: wp.array2d(dtype=wp.vec3),
    controls: wp.array3d(dtype=wp.vec4),
    states: wp.array3d(dtype=wp.vec3),
    positions: wp.array3d(dtype=wp.vec3),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
):
    """Roll out the optimised controls and the braking candidates. Launched over [B (M + BRAKING_CANDIDATES)]."""
    i = wp.tid()
    b = i // instances
    m = i % instances
    c = params[b]
    N = controls.shape[2]
    p = position[b]
    v = velocity[b]
    q = quaternion[b]
    states[b, m, 0] = p
    goal = float(0.0)
    speed = float(0.0)
    for t in range(N):
        p, v, q = rk4(p, v, q, controls[b, m, t], c)
        states[b, m, t + 1] = p
        positions[i, 0, t] = p
        positions[i, 0, N + PROBES + t] = 0.5 * (states[b, m, t] + p)
        goal += goal_cost(p, v, q, goal_position[b], goal_velocity[b], goal_quaternion[b], c)
        speed += speed_cost(v, c)
    for j in range(PROBES):
        positions[i, 0, N + j] = probe_position(p, waypoint[b, m], goal_position[b], j, c)
    J_goal[b, m] = goal
    J_speed[b, m] = speed


@wp.kernel
def final_scores(
    instances: int,
    goal_position: wp.array(dtype=wp.vec3),
    waypoint: wp.array2d(dtype=wp.vec3),
    params: wp.array(dtype=Params),
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    J_goal: wp.array2d(dtype=float),
    J_speed: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
    nearest: wp.array2d(dtype=float),
):
    """Sum S2 and find the minimum clearance of every instance. Launched over [B (M + BRAKING_CANDIDATES)]."""
    i = wp.tid()
    b = i // instances
    m = i % instances
    c = params[b]
    N = (distance.shape[2] - PROBES) // 2
    least = float(1.0e9)
    for t in range(N):
        least = wp.min(least, distance[i, 0, t])
        if c.between_steps != 0:
            least = wp.min(least, distance[i, 0, N + PROBES + t])
    nearest[b, m] = least
    collision, to_go = collision_and_blocked(i, 0, N, waypoint[b, m], goal_position[b], c, positions, distance)
    J_col[b, m] = collision
    S2[b, m] = J_goal[b, m] + collision + to_go + J_speed[b, m]


@wp.kernel
def select(
    brake_index: int,
    position: wp.array(dtype=wp.vec3),
    ground_height: wp.array(dtype=float),
    params: wp.array(dtype=Params),
    cloud_age: wp.array(dtype=float),
    count: wp.array(dtype=int),
    filtered: wp.array2d(dtype=wp.vec3),
    S2: wp.array2d(dtype=float),
    nearest: wp.array2d(dtype=float),
    best: wp.array(dtype=int),
    status: wp.array(dtype=int),
    source: wp.array(dtype=int),
):
    """Select the lowest S2, with prefer_safe among the safe instances; brake if it is not safe. Launched over [B].

    status: 0 OK, 1 none safe, 2 cloud too old. `source` is the row whose controls are flown. Of the braking candidates
    it is the one with the largest clearance, and the first of several equal ones.
    """
    b = wp.tid()
    c = params[b]
    M = S2.shape[1] - BRAKING_CANDIDATES
    safe = c.safe_clearance
    start_distance = distance_to(position[b], safe, b, ground_height[b], c, count, filtered)
    if start_distance < safe:  # too near already: do not come nearer
        safe = start_distance - 0.02
    chosen = int(0)
    for m in range(1, M):
        better = S2[b, m] < S2[b, chosen]
        if c.prefer_safe != 0 and (nearest[b, m] >= safe) != (nearest[b, chosen] >= safe):
            better = nearest[b, m] >= safe
        if better:
            chosen = m
    status[b] = 0
    if nearest[b, chosen] < safe:
        status[b] = 1
    if cloud_age[b] > c.cloud_age_max:
        status[b] = 2
    source[b] = chosen
    if status[b] != 0:
        source[b] = M
        for candidate in range(M + 1, M + BRAKING_CANDIDATES):
            if nearest[b, candidate] > nearest[b, source[b]]:
                source[b] = candidate
        if brake_index >= 0:
            chosen = brake_index
    best[b] = chosen


@wp.kernel
def commit(
    best: wp.array(dtype=int),
    source: wp.array(dtype=int),
    anchor: wp.array2d(dtype=wp.vec3),
    guide: wp.array3d(dtype=wp.vec3),
    controls: wp.array3d(dtype=wp.vec4),
    states: wp.array3d(dtype=wp.vec3),
    J_goal: wp.array2d(dtype=float),
    J_col: wp.array2d(dtype=float),
    S2: wp.array2d(dtype=float),
):
    """Replace the selected instance by the row that is flown. Launched over [B]."""
    b = wp.tid()
    m = best[b]
    n = source[b]
    anchor[b, m] = anchor[b, n]
    J_goal[b, m] = J_goal[b, n]
    J_col[b, m] = J_col[b, n]
    S2[b, m] = S2[b, n]
    for t in range(controls.shape[2]):
        controls[b, m, t] = controls[b, n, t]
    for t in range(controls.shape[2] + 1):
        guide[b, m, t] = guide[b, n, t]
        states[b, m, t] = states[b, n, t]
