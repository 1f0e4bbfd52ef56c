"""Stage I, one MPPI per guide: sampled controls, their cost, softmin and update."""

from __future__ import annotations

import warp as wp

from aero_planner.reference.costs import J_col, J_ctrl, J_goal, J_track, J_vnorm
from aero_planner.reference.dynamics import State, clamp_control
from aero_planner.reference.parameters import Parameters

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample_controls(
    c: Parameters, nominal: wp.array2d(dtype=wp.vec4), noise: wp.array3d(dtype=wp.vec4),
    controls: wp.array3d(dtype=wp.vec4),
):  # fmt: skip
    """Write u_k,t = clamp(u_t + sqrt(Sigma) e_k,t), with white noise e of unit variance. Launched over [M, K, N]."""
    m, k, t = wp.tid()
    sigma = wp.vec4(wp.sqrt(c.Sigma_F), wp.sqrt(c.Sigma_xy), wp.sqrt(c.Sigma_xy), wp.sqrt(c.Sigma_z))
    controls[m, k, t] = clamp_control(nominal[m, t] + wp.cw_mul(sigma, noise[m, k, t]), c)


@wp.kernel
def stage1_cost(
    goal: State, c: Parameters, guides: wp.array2d(dtype=wp.vec3), controls: wp.array3d(dtype=wp.vec4),
    states: wp.array3d(dtype=State), distance: wp.array3d(dtype=float), S1: wp.array2d(dtype=float),
):  # fmt: skip
    """Write S1 = J_track + J_vnorm + J_ctrl + S2 of every sample, with S2 = J_goal + J_col. Launched over [M, K]."""
    m, k = wp.tid()
    N = controls.shape[2]
    S = float(0.0)
    for t in range(N):
        x = states[m, k, t + 1]
        S += J_track(x, guides[m, t + 1], c) + J_vnorm(x, c)
        S += J_ctrl(controls[m, k, t], controls[m, k, wp.max(t - 1, 0)], t, N, c)
        S += J_goal(x, goal, c) + J_col(distance[m, k, t], c)
    S1[m, k] = S


@wp.kernel
def softmin(c: Parameters, S1: wp.array2d(dtype=float), weights: wp.array2d(dtype=float)):
    """Write w_k = exp(-(S1_k - min S1) / lambda) / sum_k exp(-(S1_k - min S1) / lambda). Launched over [M]."""
    m = wp.tid()
    lowest = float(wp.INF)
    for k in range(S1.shape[1]):
        lowest = wp.min(lowest, S1[m, k])
    total = float(0.0)
    for k in range(S1.shape[1]):
        weights[m, k] = wp.exp(-(S1[m, k] - lowest) / c.lambda_)
        total += weights[m, k]
    for k in range(S1.shape[1]):
        weights[m, k] /= total


@wp.kernel
def update_controls(
    nominal: wp.array2d(dtype=wp.vec4), sampled: wp.array3d(dtype=wp.vec4), weights: wp.array2d(dtype=float),
    controls: wp.array3d(dtype=wp.vec4),
):  # fmt: skip
    """Write u_t + sum_k w_k (u_k,t - u_t), with the noise as it acted, after the clamp. Launched over [M, N]."""
    m, t = wp.tid()
    change = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(weights.shape[1]):
        change += weights[m, k] * (sampled[m, k, t] - nominal[m, t])
    controls[m, 0, t] = nominal[m, t] + change
