"""The problem with pytorch_mppi: one `MPPI` per instance, costs of all states at once, clearance by cdist."""
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable

import torch
from pytorch_mppi import MPPI

from benchmarks.comparison.problem import Problem

_ROWS = 4096
"""Positions whose distances to the whole cloud are held in memory at once."""


def _controllers(problem: Problem, device: str) -> tuple[list[MPPI], torch.Tensor]:
    config, N = problem.config, problem.config.sampling.steps
    c, vehicle, dt = config.costs, config.vehicle, config.sampling.dt

    def tensor(values: object) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=device)

    cloud, low, high = tensor(problem.cloud), *(tensor(limit) for limit in problem.limits)
    p_goal, q_goal, v_goal = tensor(problem.goal).split([3, 4, 3])
    gravity = tensor([0.0, 0.0, -vehicle.gravity])

    def derivative(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        w, i, j, k = x[:, 3], x[:, 4], x[:, 5], x[:, 6]
        a, b, d = u[:, 1], u[:, 2], u[:, 3]
        dq = 0.5 * torch.stack((-i * a - j * b - k * d, w * a + j * d - k * b, w * b - i * d + k * a,
                                w * d + i * b - j * a), dim=1)  # fmt: skip
        axis = torch.stack((2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)), dim=1)
        return torch.cat((x[:, 7:], dq, axis * (u[:, :1] / vehicle.mass) + gravity), dim=1)

    def dynamics(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        k1 = derivative(x, u)
        k2 = derivative(x + 0.5 * dt * k1, u)
        k3 = derivative(x + 0.5 * dt * k2, u)
        k4 = derivative(x + dt * k3, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return torch.cat((x[:, :3], torch.nn.functional.normalize(x[:, 3:7], dim=1), x[:, 7:]), dim=1)

    def clearance(p: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.cdist(rows, cloud).amin(dim=1) for rows in p.split(_ROWS)])

    def trajectory_cost(guide: torch.Tensor) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        def cost(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
            x, u = states[0], actions[0]
            p, q, v = x.split([3, 4, 3], dim=-1)
            w, i, j, k = q.unbind(dim=-1)
            g = q_goal
            e = torch.stack((i * g[0] - w * g[1] - j * g[3] + k * g[2], j * g[0] - w * g[2] - k * g[1] + i * g[3],
                             k * g[0] - w * g[3] - i * g[2] + j * g[1]), dim=-1)  # fmt: skip
            d = clearance(p.reshape(-1, 3)).reshape(p.shape[:2])
            collision = c.penalty * torch.exp(-c.decay * (d - c.distance_min).clamp(min=0))
            steps = (
                c.q_track * (p - guide).norm(dim=-1)
                + c.q_vnorm * v.square().sum(dim=-1)
                + c.q_position * (p - p_goal).norm(dim=-1)
                + c.q_velocity * (v - v_goal).norm(dim=-1)
                + c.q_attitude * 8**0.5 * e.norm(dim=-1)
                + torch.where(d < c.distance_max, collision, 0.0)
            ).sum(dim=1)
            change = u[:, 1 : N - 1] - u[:, : N - 2]
            control = c.q_control * u[:, : N - 1].square().sum(dim=(1, 2))
            return (steps + control + c.q_control_rate * change.square().sum(dim=(1, 2)))[None]

        return cost

    return [
        MPPI(
            dynamics,
            lambda x, u: x.new_zeros(len(x)),
            nx=10,
            noise_sigma=torch.diag(tensor(problem.variance)),
            num_samples=config.sampling.samples,
            horizon=N,
            device=device,
            terminal_state_cost=trajectory_cost(tensor(guide[1:])),
            lambda_=config.sampling.temperature,
            u_min=low,
            u_max=high,
            U_init=tensor(nominal),
        )
        for guide, nominal in zip(problem.guides, problem.nominal, strict=True)
    ], tensor(problem.state)


def make_runner(problem: Problem, device: str) -> Callable[[], None]:
    """Return a function that updates the nominal controls of every instance once, and waits for the result."""
    controllers, state = _controllers(problem, device)
    nominal = [controller.U for controller in controllers]

    def run() -> None:
        with torch.no_grad():
            for controller, U in zip(controllers, nominal, strict=True):
                controller.U = U
                controller.command(state, shift_nominal_trajectory=False)
        if state.is_cuda:
            torch.cuda.synchronize()

    return run


def nominal_costs(problem: Problem) -> list[float]:
    """Return S1 of the nominal controls of every instance, shape [M]."""
    controllers, state = _controllers(problem, "cpu")
    found = []
    for controller in controllers:
        controller.state = state
        found.append(float(controller._compute_rollout_costs(controller.U[None])[0][0]))
    return found
