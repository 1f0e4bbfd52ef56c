"""The cost terms that ship: those of the paper, then the speed limit, the jump of controls and the cost-to-go.

In the sums over t = 0 .. N-1, step t is the state after control t.
"""

# Postponed annotations are left out: Warp functions need the types themselves.

from typing import Any

import warp as wp

from aero_planner.costs.cost_term import CostTerm, End, Step
from aero_planner.device.rotations import quat_multiply

wp.set_module_options({"enable_backward": False})


@wp.func
def track_cost(s: Step, c: Any) -> float:
    """Return J_track: Q_track |p - p_traj|."""
    return c.q_track * float(s.is_guided) * wp.length(s.p - s.p_guide)


@wp.func
def vnorm_cost(s: Step, c: Any) -> float:
    """Return J_vnorm: Q_vnorm |v|^2."""
    return c.q_vnorm * wp.dot(s.v, s.v)


@wp.func
def control_cost(s: Step, c: Any) -> float:
    """Return the first part of J_ctrl: Q_c |u|^2 for t = 0 .. N-2."""
    return wp.where(s.t < s.last, c.q_control, 0.0) * wp.dot(s.u, s.u)


@wp.func
def control_rate_cost(s: Step, c: Any) -> float:
    """Return the second part of J_ctrl: Q_cd |u_t - u_{t-1}|^2 for t = 1 .. N-2."""
    du = s.u - s.u_before
    return wp.where(s.t > 0 and s.t < s.last, c.q_control_rate, 0.0) * wp.dot(du, du)


@wp.func
def goal_position_cost(s: Step, c: Any) -> float:
    """Return the first part of J_goal: Q_p |p - p_goal|."""
    return c.q_position * wp.length(s.p - s.p_goal)


@wp.func
def goal_velocity_cost(s: Step, c: Any) -> float:
    """Return the second part of J_goal: Q_v |v - v_goal|."""
    return c.q_velocity * wp.length(s.v - s.v_goal)


@wp.func
def attitude_distance(q: wp.vec4, q_goal: wp.vec4) -> float:
    """Return |R(q) R(q_goal)^T - I|_F.

    It equals sqrt(8) |vector part of q (x) q_goal^-1|, which suffers no cancellation near zero.
    """
    e = quat_multiply(q, wp.vec4(q_goal[0], -q_goal[1], -q_goal[2], -q_goal[3]))
    return wp.sqrt(8.0 * (e[1] * e[1] + e[2] * e[2] + e[3] * e[3]))


@wp.func
def goal_attitude_cost(s: Step, c: Any) -> float:
    """Return the third part of J_goal: Q_q |R(q) R(q_goal)^T - I|_F."""
    return c.q_attitude * attitude_distance(s.q, s.q_goal)


@wp.func
def collision_cost(d: float, c: Any) -> float:
    """Return J_col at clearance d [m]. It is zero from d_max on and has one of two shapes below.

    "exponential" is the paper's: C below d_min, C exp(-a (d - d_min)) above. "quadratic" is w s^2 with
    s = (d_max - d) / (d_max - d_min) above d_min, and C (2 - d / d_min) below, so that among colliding rollouts a wider
    miss costs less; w is soft_weight.
    """
    # Without branches a CPU evaluates it for many samples at once.
    s = (c.distance_max - d) / (c.distance_max - c.distance_min)
    cost = wp.where(d < c.distance_min, c.penalty * (2.0 - d / c.distance_min), c.soft_weight * s * s)
    if c.shape == 1:
        cost = c.penalty * wp.exp(-c.decay * wp.max(0.0, d - c.distance_min))
    return wp.where(d < c.distance_max, cost, 0.0)


@wp.func
def speed_cost(s: Step, c: Any) -> float:
    """Return q_speed max(0, |v| - speed_limit)^2. The paper does not have it."""
    excess = wp.max(0.0, wp.length(s.v) - c.speed_limit)
    return c.q_speed * excess * excess


@wp.func
def control_jump_cost(s: Step, c: Any) -> float:
    """Return q_control_jump |omega_0 - omega|^2 + q_thrust_jump (F_0 - F)^2 for the first control of a plan.

    F and omega are those of the command in force. The paper does not have it.
    """
    du = s.u - s.u_before
    jump = c.q_thrust_jump * du[0] * du[0] + c.q_control_jump * (du[1] * du[1] + du[2] * du[2] + du[3] * du[3])
    return wp.where(s.t == 0, jump, 0.0)


@wp.func
def blocked_path_cost(e: End, views: Any, c: Any) -> float:
    """Return the cost-to-go: q_blocked times the blocked length of the straight path from the end to the goal.

    The paper does not have it.
    """
    return c.q_blocked * wp.min(c.lookahead, wp.length(e.p_goal - e.p)) * e.blocked


TERMS = (
    CostTerm("guide_tracking", "guide tracking", "J_track", in_stage2=False, running=track_cost),
    CostTerm("speed", "speed", "J_vnorm", in_stage2=False, running=vnorm_cost),
    CostTerm("control_effort", "control effort", "J_ctrl", in_stage2=False, running=control_cost),
    CostTerm("control_change", "control change", "J_ctrl", in_stage2=False, running=control_rate_cost),
    CostTerm("goal_position", "goal position", "J_goal", running=goal_position_cost),
    CostTerm("goal_velocity", "goal velocity", "J_goal", running=goal_velocity_cost),
    CostTerm("goal_attitude", "goal attitude", "J_goal", running=goal_attitude_cost),
    CostTerm("obstacles", "obstacles", "J_col", obstacle=collision_cost),
    CostTerm("speed_limit", "speed limit", running=speed_cost),
    CostTerm("control_jump", "control jump", running=control_jump_cost, model="ctbr"),
    CostTerm("blocked_path", "blocked path", terminal=blocked_path_cost),
)
"""In the order in which sums and bars list them."""
