"""The costs. The state of step t = 0 .. N-1 is the one after control u_t; the goal is a state [p, q, v]_goal."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.dynamics import State, rotation
from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})


@wp.func
def J_track(x: State, p_traj: wp.vec3, c: Parameters) -> float:
    """Return a step of J_track = sum Q_track |p - p_traj|."""
    return c.Q_track * wp.length(x.p - p_traj)


@wp.func
def J_vnorm(x: State, c: Parameters) -> float:
    """Return a step of J_vnorm = sum Q_vnorm |v|^2."""
    return c.Q_vnorm * wp.dot(x.v, x.v)


@wp.func
def J_ctrl(u: wp.vec4, u_before: wp.vec4, t: int, N: int, c: Parameters) -> float:
    """Return a step of J_ctrl = sum_{0..N-2} Q_c |u_t|^2 + sum_{1..N-2} Q_cd |u_t - u_{t-1}|^2."""
    J = float(0.0)
    if t <= N - 2:
        J += c.Q_c * wp.dot(u, u)
    if t >= 1 and t <= N - 2:
        J += c.Q_cd * wp.dot(u - u_before, u - u_before)
    return J


@wp.func
def attitude_distance(q: wp.vec4, q_goal: wp.vec4) -> float:
    """Return |R(q) R(q_goal)^T - I|_F."""
    E = rotation(q) * wp.transpose(rotation(q_goal)) - wp.identity(n=3, dtype=float)
    return wp.sqrt(wp.ddot(E, E))


@wp.func
def J_goal(x: State, goal: State, c: Parameters) -> float:
    """Return a step of J_goal = sum Q_p |p - p_goal| + Q_v |v - v_goal| + Q_q |R(q) R(q_goal)^T - I|_F."""
    return (
        c.Q_p * wp.length(x.p - goal.p)
        + c.Q_v * wp.length(x.v - goal.v)
        + c.Q_q * attitude_distance(x.q, goal.q)
    )  # fmt: skip


@wp.func
def J_col(d: float, c: Parameters) -> float:
    """Return a step of J_col: C if d < d_min, C exp(-a (d - d_min)) if d_min <= d < d_max, else 0."""
    if d < c.d_min:
        return c.C
    if d < c.d_max:
        return c.C * wp.exp(-c.a * (d - c.d_min))
    return 0.0


@wp.kernel
def clearance(filtered: wp.array2d(dtype=wp.vec3), states: wp.array3d(dtype=State), distance: wp.array3d(dtype=float)):
    """Write d = min |p - p_ij|, the exact distance to the filtered cloud. Launched over [M, K, N]."""
    m, k, t = wp.tid()
    p = states[m, k, t + 1].p
    square = float(wp.INF)
    for i in range(filtered.shape[0]):
        for j in range(filtered.shape[1]):
            offset = filtered[i, j] - p
            square = wp.min(square, wp.dot(offset, offset))
    distance[m, k, t] = wp.sqrt(square)
