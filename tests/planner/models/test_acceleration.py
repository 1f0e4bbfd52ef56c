"""The acceleration-commanded vehicle against its equations."""

from typing import Any

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from tests.planner import reference
from tests.planner.cases import config_of, random_case
from tests.planner.models.test_models import control, roll_out
from tests.planner.reference import Array

NAME = "acceleration"
ATTITUDE_LAG = 0.08  # [s]
LAGS: list[dict[str, Any]] = [{}, {"vehicle__thrust_lag": 0.04, "vehicle__rate_lag": 0.03}]


def toward(a: Array, u: Array, time: float, config: PlannerConfig) -> Array:
    """Return a after it has gone toward u for a time [s]: with a lag and a bounded jerk along x and y."""
    vehicle, d = config.vehicle, u - a
    level = min(
        1.0 - np.exp(-time / (ATTITUDE_LAG + vehicle.rate_lag)),
        time * vehicle.rate_xy_max * vehicle.gravity / max(float(np.linalg.norm(d[:2])), 1e-12),
    )
    return a + np.array([level, level, climb_share(time, config)]) * d


def climb_share(time: float, config: PlannerConfig) -> float:
    """Return the share of the way to its command that the acceleration along z goes in a time [s]."""
    return 1.0 - np.exp(-time / config.vehicle.thrust_lag) if config.vehicle.thrust_lag else 1.0


def integrate(
    v: Array, acting: Array, controls: Array, config: PlannerConfig, disturbance: Array, drag: float, *, parts: int
) -> tuple[Array, Array, Array]:
    """Return p, v and the accelerations in effect after each control, integrated in `parts` steps per time step."""
    p, dt = np.zeros(3), config.sampling.dt / parts
    remaining = config.vehicle.thrust_lag * climb_share(dt, config) / dt  # mean along z
    a, states = acting[:3], []
    for u in controls:
        for _ in range(parts):
            after = toward(a, u[:3], dt, config)
            mean = 0.5 * (a + after)
            mean[2] = u[2] + remaining * (a[2] - u[2])
            acceleration = mean + disturbance - drag * v
            p, v, a = p + dt * v + 0.5 * dt * dt * acceleration, v + dt * acceleration, after
        states.append((p, v, a))
    p, v, a = (np.array(x) for x in zip(*states, strict=True))
    return p, v, a


def random_controls(rng: np.random.Generator, steps: int = 25) -> Array:
    """Return accelerations that change faster than the vehicle can, and yaw rates."""
    u = np.concatenate((rng.normal(size=(steps, 3)) * 5.0, rng.uniform(-1.5, 1.5, (steps, 1))), axis=1)
    return u.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("lags", LAGS)
@pytest.mark.parametrize("drag", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_steps_are_those_of_the_equations(device: str, seed: int, drag: float, lags: dict[str, Any]):
    config, rng = config_of(**lags), np.random.default_rng(seed)
    v, disturbance, u = rng.normal(size=3) * 3.0, rng.normal(size=3) if drag else np.zeros(3), random_controls(rng)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    p, velocities, _, acting = roll_out(NAME, config, device, v, level, np.zeros(4), u, disturbance, drag)
    expected = integrate(v, np.zeros(4), u, config, disturbance, drag, parts=1)
    for found, values in zip((p, velocities, acting[:, :3]), expected, strict=True):
        np.testing.assert_allclose(found, values, atol=2e-5)
    np.testing.assert_allclose(acting[:, 3], u[:, 3], rtol=1e-6)
    jerk = np.linalg.norm(np.diff(acting[:, :2], axis=0, prepend=0.0), axis=1) / config.sampling.dt
    limit = config.vehicle.rate_xy_max * config.vehicle.gravity
    assert jerk.max() <= limit * 1.0001 and (jerk > limit * 0.999).sum() > 10
    # A time step hardly differs from the differential equation itself.
    exact = integrate(v, np.zeros(4), u, config, disturbance, drag, parts=100)
    assert (
        np.linalg.norm(p - exact[0], axis=1).max() < 0.05 and np.linalg.norm(velocities - exact[1], axis=1).max() < 0.1
    )


@pytest.mark.parametrize("lags", LAGS)
def test_a_finer_step_is_nearer_to_the_differential_equation(lags: dict[str, Any]):
    config, wind = config_of(**lags), np.array([0.4, -0.3, 0.2])
    errors = np.zeros(3)
    for seed in range(4):
        v, u = np.array([3.0, -1.0, 0.5]), random_controls(np.random.default_rng(seed))
        exact, *finer = (integrate(v, np.zeros(4), u, config, wind, 0.3, parts=parts)[0] for parts in (400, 1, 2, 4))
        errors += [np.sqrt(np.mean((p - exact) ** 2)) for p in finer]
    assert errors[0] > 1.6 * errors[1] > 2.5 * errors[2]


@pytest.mark.parametrize("seed", range(3))
def test_the_thrust_gives_the_acceleration_and_the_yaw_turns_at_its_rate(device: str, seed: int):
    config, rng = config_of(), np.random.default_rng(seed)
    u, heading = random_controls(rng, 40), 1.1
    level = np.array([np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)])
    _, _, q, acting = roll_out(NAME, config, device, np.zeros(3), level, np.zeros(4), u)
    for t, (attitude, a) in enumerate(zip(q, acting, strict=True)):
        f = np.add(a[:3], [0.0, 0.0, config.vehicle.gravity])
        np.testing.assert_allclose(reference.rotation(attitude)[:, 2], reference.unit(f), atol=1e-5)
        # Of q = tilt (x) yaw, tilt is the shortest rotation to the thrust: yaw is the angle of (w, z).
        turned = heading + config.sampling.dt * u[: t + 1, 3].sum()
        yaw = 2.0 * np.arctan2(attitude[3], attitude[0])
        # The heading advances by atan(dt rate / 2) a step, which is dt rate / 2 to the third order.
        assert abs((yaw - turned + np.pi) % (2.0 * np.pi) - np.pi) < 2e-3


@pytest.mark.parametrize(
    "changes", [{}, {"vehicle__mass": 2.0, "vehicle__thrust_max": 30.0, "vehicle__rate_z_max": 1.0}]
)
def test_controls_are_bounded_by_thrust_and_yaw_rate(device: str, changes: dict[str, Any]):
    config, rng = config_of(**changes), np.random.default_rng(0)
    v, wanted = config.vehicle, rng.normal(size=(500, 4)) * [8.0, 8.0, 15.0, 3.0]
    u = control(NAME, "clamp", config, device, wanted)
    f = u[:, :3] + [0.0, 0.0, v.gravity]
    thrust = v.mass * np.linalg.norm(f, axis=1)
    assert thrust.max() <= v.thrust_max * 1.0001 and thrust.min() >= v.thrust_min * 0.9999
    assert (v.mass * f[:, 2] >= v.thrust_min * 0.9999).all()
    np.testing.assert_allclose(u[:, 3], np.clip(wanted[:, 3], -v.rate_z_max, v.rate_z_max), rtol=1e-6)
    # Within the bounds nothing changes; a thrust that is too large keeps its direction.
    g = wanted[:, :3] + [0.0, 0.0, v.gravity]
    demanded = v.mass * np.linalg.norm(g, axis=1)
    is_up = v.mass * g[:, 2] >= v.thrust_min
    is_inside = is_up & (demanded <= v.thrust_max)
    np.testing.assert_allclose(u[is_inside, :3], wanted[is_inside, :3], atol=1e-5)
    is_strong = is_up & (demanded > v.thrust_max)
    scaled = g * (v.thrust_max / demanded)[:, None]
    is_strong &= v.mass * scaled[:, 2] >= v.thrust_min
    np.testing.assert_allclose(f[is_strong], scaled[is_strong], rtol=1e-4, atol=1e-4)
    assert is_inside.sum() > 20 and is_strong.sum() > 20


def test_plans_keep_the_bounds_of_thrust_and_jerk(device: str):
    """In Stage II, whose controls are means of clamped ones, and whose accelerations follow from the velocities."""
    config = config_of(vehicle__model=NAME, sampling__variance_rate_xy=20.0, sampling__variance_thrust=20.0)
    planner, v = Planner(config, device=device), config.vehicle
    for seed in range(3):
        plan = random_case(seed, tilt=0.2).plan(planner)
        sampled = planner.workspace.sample_controls.numpy()[..., : plan.stage1_cost.shape[1]]
        for u in (plan.controls.reshape(-1, 4), sampled.swapaxes(2, 3).reshape(-1, 4)):
            f = u[:, :3] + [0.0, 0.0, v.gravity]
            assert v.mass * np.linalg.norm(f, axis=1).max() <= v.thrust_max * 1.0001
            assert v.mass * f[:, 2].min() >= v.thrust_min * 0.9999 and np.abs(u[:, 3]).max() <= v.rate_z_max * 1.0001
        accelerations = np.diff(plan.velocities.astype(np.float64), axis=1) / config.sampling.dt
        change = np.linalg.norm(np.diff(accelerations[..., :2], axis=1), axis=-1)
        # The mean acceleration of two neighbouring steps changes by no more than the largest jerk allows.
        assert change.max() <= config.sampling.dt * v.rate_xy_max * v.gravity * 1.001 + 1e-3
