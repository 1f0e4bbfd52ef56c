"""The costs of the paper, each as a function of one time step. Sums over t = 0..N-1 use the state after control t."""

from __future__ import annotations

import warp as wp

from aero_planner.kernels.dynamics import quat_multiply
from aero_planner.kernels.params import Params

wp.set_module_options({"enable_backward": False})


@wp.func
def track_cost(p: wp.vec3, p_guide: wp.vec3, params: Params) -> float:
    """Return J_track: Q_track |p - p_traj|."""
    return params.q_track * wp.length(p - p_guide)


@wp.func
def vnorm_cost(v: wp.vec3, params: Params) -> float:
    """Return J_vnorm: Q_vnorm |v|^2."""
    return params.q_vnorm * wp.dot(v, v)


@wp.func
def control_cost(u: wp.vec4, params: Params) -> float:
    """Return the first term of J_ctrl: Q_c |u|^2, for t = 0..N-2."""
    return params.q_control * wp.dot(u, u)


@wp.func
def control_rate_cost(u: wp.vec4, u_before: wp.vec4, weight: float) -> float:
    """Return weight |u_t - u_{t-1}|^2: the second term of J_ctrl, with the weight Q_cd for t = 1..N-2."""
    du = u - u_before
    return weight * wp.dot(du, du)


@wp.func
def jump_cost(u: wp.vec4, command: wp.vec4, weight: float) -> float:
    """Return weight |omega_0 - omega|^2 from the command in force to the first one of a plan; its weight is
    q_control_jump.

    It is a part of S2, an option that the paper does not have. Jumps of the thrust are free: a price on them keeps a
    drone climbing that has begun to.
    """
    du = u - command
    return weight * (du[1] * du[1] + du[2] * du[2] + du[3] * du[3])


@wp.func
def attitude_distance(q: wp.vec4, q_goal: wp.vec4) -> float:
    """Return |R(q) R(q_goal)^T - I|_F.

    It equals sqrt(8) |vector part of q (x) q_goal^-1|, which suffers no cancellation near zero.
    """
    e = quat_multiply(q, wp.vec4(q_goal[0], -q_goal[1], -q_goal[2], -q_goal[3]))
    return wp.sqrt(8.0 * (e[1] * e[1] + e[2] * e[2] + e[3] * e[3]))


@wp.func
def goal_cost(
    p: wp.vec3, v: wp.vec3, q: wp.vec4, p_goal: wp.vec3, v_goal: wp.vec3, q_goal: wp.vec4, params: Params
) -> float:
    """Return J_goal: Q_p |p - p_goal| + Q_v |v - v_goal| + Q_q |R(q) R(q_goal)^T - I|_F."""
    return (
        params.q_position * wp.length(p - p_goal)
        + params.q_height * wp.abs(p[2] - p_goal[2])
        + params.q_velocity * wp.length(v - v_goal)
        + params.q_attitude * attitude_distance(q, q_goal)
    )


@wp.func
def collision_cost(d: float, params: Params) -> float:
    """Return J_col at clearance d [m]. It is zero from d_max on and has one of two shapes below.

    "exponential" is the paper's: C below d_min, C exp(-a (d - d_min)) above. "quadratic" is w s^2 with
    s = (d_max - d) / (d_max - d_min) above d_min, and C (2 - d / d_min) below, so that among colliding rollouts a wider
    miss costs less; w is soft_weight min(1, speed_limit / soft_speed).
    """
    # Without branches a CPU evaluates it for many samples at once.
    s = (params.distance_max - d) / (params.distance_max - params.distance_min)
    soft = params.soft_weight * wp.min(1.0, params.speed_limit / params.soft_speed)
    cost = wp.where(d < params.distance_min, params.penalty * (2.0 - d / params.distance_min), soft * s * s)
    if params.shape == 1:
        cost = params.penalty * wp.exp(-params.decay * wp.max(0.0, d - params.distance_min))
    return wp.where(d < params.distance_max, cost, 0.0)


@wp.func
def speed_cost(v: wp.vec3, params: Params) -> float:
    """Return q_speed (max(0, |v| - speed_limit)^2 + max(0, -v_z - descent_limit)^2).

    It is an option that the paper does not have.
    """
    excess = wp.max(0.0, wp.length(v) - params.speed_limit)
    descent = wp.max(0.0, -v[2] - params.descent_limit)
    return params.q_speed * (excess * excess + descent * descent)
