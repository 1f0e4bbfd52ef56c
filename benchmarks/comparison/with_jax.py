"""The problem with jax_mppi: one jitted call, instances under vmap, brute-force clearance."""
# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax_mppi import mppi

from benchmarks.comparison.problem import Problem


def _functions(problem: Problem) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any], Any]:
    """Return dynamics, running cost and terminal cost for a guide, and the start.

    The state includes the previous control, since the library evaluates a state together with the next control.
    """
    config, N = problem.config, problem.config.sampling.steps
    c, vehicle, dt = config.costs, config.vehicle, config.sampling.dt
    cloud, goal = jnp.asarray(problem.cloud), jnp.asarray(problem.goal)
    gravity = jnp.array([0.0, 0.0, -vehicle.gravity])

    def derivative(x: Any, u: Any) -> Any:
        w, i, j, k = x[3:7]
        a, b, d = u[1:]
        dq = 0.5 * jnp.array([-i * a - j * b - k * d, w * a + j * d - k * b, w * b - i * d + k * a,
                              w * d + i * b - j * a])  # fmt: skip
        axis = jnp.array([2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)])
        return jnp.concatenate((x[7:], dq, axis * (u[0] / vehicle.mass) + gravity))

    def dynamics(state: Any, u: Any, t: Any) -> Any:
        x = state[:10]
        k1 = derivative(x, u)
        k2 = derivative(x + 0.5 * dt * k1, u)
        k3 = derivative(x + 0.5 * dt * k2, u)
        k4 = derivative(x + dt * k3, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return jnp.concatenate((x[:3], x[3:7] / jnp.linalg.norm(x[3:7]), x[7:], u))

    def state_cost(state: Any, place: Any) -> Any:
        p, (w, i, j, k), v, g = state[:3], state[3:7], state[7:10], goal[3:7]
        e = jnp.array([i * g[0] - w * g[1] - j * g[3] + k * g[2], j * g[0] - w * g[2] - k * g[1] + i * g[3],
                       k * g[0] - w * g[3] - i * g[2] + j * g[1]])  # fmt: skip
        d = jnp.sqrt(jnp.min(jnp.sum((cloud - p) ** 2, axis=1)))
        collision = c.penalty * jnp.exp(-c.decay * jnp.maximum(0.0, d - c.distance_min))
        return (
            c.q_track * jnp.linalg.norm(p - place)
            + c.q_vnorm * jnp.dot(v, v)
            + c.q_position * jnp.linalg.norm(p - goal[:3])
            + c.q_velocity * jnp.linalg.norm(v - goal[7:])
            + c.q_attitude * 8**0.5 * jnp.linalg.norm(e)
            + jnp.where(d < c.distance_max, collision, 0.0)
        )

    def running_cost(guide: Any) -> Callable[..., Any]:
        def cost(state: Any, u: Any, t: Any) -> Any:
            change = u - state[10:]
            rate = jnp.where(t > 0, c.q_control_rate * jnp.dot(change, change), 0.0)
            control = jnp.where(t < N - 1, c.q_control * jnp.dot(u, u) + rate, 0.0)
            return control + jnp.where(t > 0, state_cost(state, guide[t]), 0.0)

        return cost

    def terminal_cost(guide: Any) -> Callable[..., Any]:
        return lambda state, u: state_cost(state, guide[N])

    return dynamics, running_cost, terminal_cost, jnp.concatenate((jnp.asarray(problem.state), jnp.zeros(4)))


def make_runner(problem: Problem, device: str) -> Callable[[], None]:
    """Return a function that updates the nominal controls of every instance once, and waits for the result."""
    config = problem.config
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")  # the CUDA plugin may be installed without a driver
    with jax.default_device(jax.devices("cpu" if device == "cpu" else "cuda")[0]):
        dynamics, running_cost, terminal_cost, state = _functions(problem)
        guides, nominal = jnp.asarray(problem.guides), jnp.asarray(problem.nominal)
        low, high = (jnp.array(limit) for limit in problem.limits)
        keys = jax.random.split(jax.random.PRNGKey(0), len(nominal))

        def improve(key: Any, guide: Any, U: Any) -> Any:
            settings, start = mppi.create(
                nx=14, nu=4, noise_sigma=jnp.diag(jnp.array(problem.variance)), num_samples=config.sampling.samples,
                horizon=config.sampling.steps, lambda_=config.sampling.temperature, u_min=low, u_max=high, U_init=U,
                step_dependent_dynamics=True, key=key,
            )  # fmt: skip
            _, end = mppi.command(
                settings, start, state, dynamics, running_cost(guide), terminal_cost(guide), shift=False
            )
            return end.U

        command = jax.jit(jax.vmap(improve))

    def run() -> None:
        command(keys, guides, nominal).block_until_ready()

    return run


def nominal_costs(problem: Problem) -> list[float]:
    """Return S1 of the nominal controls of every instance, shape [M]."""
    dynamics, running_cost, terminal_cost, state = _functions(problem)
    settings, _ = mppi.create(
        nx=14, nu=4, noise_sigma=jnp.eye(4), horizon=problem.config.sampling.steps, step_dependent_dynamics=True
    )
    return [
        float(mppi._compute_rollout_costs(settings, state, jnp.asarray(U)[None], dynamics,
                                          running_cost(jnp.asarray(guide)), terminal_cost(jnp.asarray(guide)))[0])
        for guide, U in zip(problem.guides, problem.nominal, strict=True)
    ]  # fmt: skip
