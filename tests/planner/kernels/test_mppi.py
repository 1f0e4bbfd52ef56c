from typing import Any

import numpy as np
import pytest

from aero_planner import Plan, Planner, PlannerConfig, PlanStatus
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, level_case, random_case


def sampled_controls(planner: Planner, plan: Plan) -> np.ndarray:
    """Return the controls of every sample, shape [M, N, K, 4]."""
    return planner.workspace.sample_controls.numpy()[..., : plan.stage1_cost.shape[1]].swapaxes(2, 3)


def command_in_force(planner: Planner) -> np.ndarray:
    """Return the command from which the last plan started, shape [4]."""
    return planner.workspace.command.numpy()[0].astype(np.float64)


def on_an_edge(x: reference.Rollout, case: Case, plan: Plan, config: PlannerConfig) -> bool:
    """Return True if float32 may put a position of this rollout on the other side of a step of the penalties.

    Rollouts agree to 1e-4 m (see test_ctbr).
    """
    places, _ = reference.probes(x.p[-1], case.goal, config)
    d = reference.clearance(np.concatenate((x.p, places)), kept_points(plan), 10.0)
    edges = (config.costs.distance_min, config.costs.distance_max)
    return bool(min(np.abs(d - edge).min() for edge in edges) < 2e-4)


# Sums of 25 x 7 terms in float32, and penalties whose exponent moves by 5 1/m x 1e-4 m.
COST: dict[str, Any] = {"rtol": 1e-3, "atol": 0.05}


@pytest.mark.parametrize(("preset", "speed"), [("default", 4.0), ("default", 0.3), ("paper", 4.0)])
@pytest.mark.parametrize("seed", range(3))
def test_S1_of_samples(device: str, preset: str, speed: float, seed: int):
    config, case = config_of(preset), random_case(seed, nearest=0.8, count=500, speed=speed)
    planner = Planner(config, device=device)
    case.plan(planner)
    plan = case.plan(planner)  # the second, so that the previous candidate flies the previous plan
    controls, command, checked = sampled_controls(planner, plan), command_in_force(planner), 0
    for m, kind in enumerate(planner.config.kinds):
        if plan.kinds[m] != kind:
            continue  # replaced by braking, guide included
        guide = None if kind == "previous" else plan.guides[m, 1:].astype(np.float64)
        for k in (0, 5, 11):
            u = controls[m, :, k].astype(np.float64)
            x = reference.roll_out(case.position, case.quaternion, case.velocity, u, config)
            if on_an_edge(x, case, plan, config):
                continue
            expected = reference.S1(x, u, guide, case.full_goal(), kept_points(plan), command, config)
            np.testing.assert_allclose(plan.stage1_cost[m, k], expected, **COST)
            checked += 1
    assert checked > 20


@pytest.mark.parametrize(("preset", "speed"), [("default", 9.0), ("default", 0.3), ("paper", 9.0)])
@pytest.mark.parametrize("seed", range(3))
def test_S2_and_its_terms(device: str, preset: str, speed: float, seed: int):
    config, case = config_of(preset), random_case(seed, nearest=0.8, count=500, speed=speed)
    planner = Planner(config, device=device)
    plan = case.plan(planner)
    checked = 0
    for m in range(len(plan.kinds)):
        x = reference.roll_out(case.position, case.quaternion, case.velocity, plan.controls[m], config)
        np.testing.assert_allclose(plan.goal_cost[m], reference.J_goal(x, *case.full_goal(), config).sum(), rtol=2e-5)
        if on_an_edge(x, case, plan, config):
            continue
        d = reference.clearance(x.p, kept_points(plan), config.costs.distance_max)
        np.testing.assert_allclose(plan.collision_cost[m], reference.J_col(d, config).sum(), **COST)
        u = plan.controls[m].astype(np.float64)
        expected = reference.S2(x, u, case.full_goal(), kept_points(plan), command_in_force(planner), config)
        np.testing.assert_allclose(plan.stage2_cost[m], expected, **COST)
        checked += 1
    assert checked > 4
    if preset == "paper":
        np.testing.assert_allclose(plan.stage2_cost, plan.goal_cost + plan.collision_cost, rtol=1e-6)


ONLY_CONTROLS: dict[str, Any] = {
    "costs__q_position": 0.0, "costs__q_velocity": 0.0, "costs__q_attitude": 0.0, "costs__q_vnorm": 0.0,
    "costs__q_track": 0.0, "costs__q_speed": 0.0, "costs__q_blocked": 0.0, "costs__penalty": 0.0,
    "costs__soft_weight": 0.0, "costs__q_thrust_jump": 0.0, "stages__active": "",
}  # fmt: skip


@pytest.mark.parametrize(("q_control", "q_rate"), [(0.5, 0.0), (0.0, 0.5), (0.5, 0.25)])
@pytest.mark.parametrize("steps", [2, 3, 25])
def test_J_ctrl_leaves_the_last_control_free(device: str, q_control: float, q_rate: float, steps: int):
    config = config_of(costs__q_control=q_control, costs__q_control_rate=q_rate, sampling__steps=steps, **ONLY_CONTROLS)
    planner = Planner(config, device=device)
    plan = random_case(0).plan(planner)
    u = sampled_controls(planner, plan).astype(np.float64)
    expected = [[reference.J_ctrl(u[m, :, k], config).sum() for k in range(16)] for m in range(16)]
    np.testing.assert_allclose(plan.stage1_cost, expected, rtol=1e-5)


@pytest.mark.parametrize(("q_control_jump", "q_thrust_jump"), [(2.0, 0.0), (0.0, 3.0), (2.0, 3.0)])
def test_the_jump_of_the_controls_counts_in_both_stages(device: str, q_control_jump: float, q_thrust_jump: float):
    """It counts for each sample, and in the selection for each instance."""
    config = config_of(costs__q_control=0.0, costs__q_control_rate=0.5, **ONLY_CONTROLS)
    jumps_cost = {"costs.q_control_jump": q_control_jump, "costs.q_thrust_jump": q_thrust_jump}
    config = config.replace(jumps_cost)
    planner = Planner(config, device=device)
    flown = random_case(0).plan(planner).command[0].astype(np.float64)
    plan = random_case(1).plan(planner)  # 0.02 s later, within the first step
    np.testing.assert_allclose(planner.workspace.command.numpy()[0], flown, atol=1e-6)
    u = sampled_controls(planner, plan).astype(np.float64)
    terms = reference.J_ctrl, lambda u, config: reference.J_jump(u, flown, config)
    expected = [[sum(term(u[m, :, k], config).sum() for term in terms) for k in range(16)] for m in range(16)]
    np.testing.assert_allclose(plan.stage1_cost, expected, rtol=1e-5)
    jumps = np.array([reference.J_jump(u, flown, config).sum() for u in plan.controls.astype(np.float64)])
    assert jumps.max() > 1.0
    np.testing.assert_allclose(plan.stage2_cost, jumps, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("q_jump", [0.0, 2.0])
def test_where_jumps_cost_the_first_sample_has_no_noise(device: str, q_jump: float):
    planner = Planner(config_of(costs__q_control_jump=q_jump), device=device)
    plan = random_case(0).plan(planner)
    nominal = planner.workspace.nominal_controls.numpy()[0, : len(plan.kinds)]
    noise = np.abs(sampled_controls(planner, plan) - nominal[:, :, None]).max(axis=(1, 3))
    assert (noise[:, 0].max() < 1e-6) == (q_jump > 0.0) and noise[:, 1:].min() > 1e-3


@pytest.mark.parametrize("temperature", [0.1, 50.0])
@pytest.mark.parametrize("seed", range(3))
def test_update_is_the_softmin_of_the_samples(device: str, temperature: float, seed: int):
    fixed: dict[str, Any] = {"sampling__temperature": temperature, "sampling__effective_samples": 0.0}
    config, case = config_of(sampling__samples=64, **fixed), random_case(seed)
    planner = Planner(config, device=device)
    plan = case.plan(planner)
    np.testing.assert_array_equal(plan.temperature, np.float32(temperature))
    weights = reference.softmin(plan.stage1_cost.astype(np.float64), temperature)
    expected = np.einsum("mk,mnkc->mnc", weights, sampled_controls(planner, plan))
    kept = np.array(plan.kinds) == np.array(config.kinds)
    if plan.status != PlanStatus.OK:
        kept[plan.best] = False
    # min S - S is exact where it matters; 64 weights of up to 1, controls of up to 16 N.
    np.testing.assert_allclose(plan.controls[kept], expected[kept], atol=5e-5)
    assert kept.sum() >= 14 and weights.max() < 1.0 + 1e-12


@pytest.mark.parametrize("asked", [1.0, 4.0, 20.0, 64.0])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_temperature_keeps_the_effective_sample_size(device: str, asked: float, scale: float):
    """Whatever the scale of the costs, unless it would exceed the largest temperature."""
    changes: dict[str, Any] = {
        "sampling__effective_samples": asked,
        "sampling__samples": 64,
        "sampling__temperature": 30.0,
    }
    config = config_of(**changes, costs__q_position=0.01 * scale, costs__q_track=0.01 * scale)
    plan = random_case(1, count=0).plan(Planner(config, device=device))
    assert plan.temperature is not None
    weights = reference.softmin(plan.stage1_cost.astype(np.float64), plan.temperature[:, None].astype(np.float64))
    size = 1.0 / (weights**2).sum(axis=1)
    assert (size < 1.001 * asked).all() and (plan.temperature < 30.001).all()
    below = plan.temperature < 29.9
    np.testing.assert_allclose(size[below], asked, rtol=0.03)  # the temperature is found to 0.3 %
    assert below.any() or asked == 64.0


def test_weights_spread_with_the_temperature(device: str):
    """At a very high temperature all samples count the same, and the update is their mean."""
    config = config_of("paper", sampling__temperature=1000.0, sampling__samples=64, **ONLY_CONTROLS)
    planner = Planner(config.replace({"costs.q_control": 0.0, "costs.q_control_rate": 0.0}), device=device)
    plan = random_case(0, count=0).plan(planner)
    np.testing.assert_allclose(plan.controls, sampled_controls(planner, plan).mean(axis=2), atol=2e-5)


def noise_of(planner: Planner, case: Case) -> np.ndarray:
    """Return the noise of every sample, shape [M, K, N, 4]; no limit may clip it."""
    plan = case.plan(planner)
    nominal = planner.workspace.nominal_controls.numpy()[0, : len(plan.kinds)]
    return (sampled_controls(planner, plan) - nominal[:, :, None]).transpose(0, 2, 1, 3)


def resting() -> Case:
    """Return a drone at rest at its goal, whose nominal controls hover: no limit clips the noise."""
    case = level_case(0.0)
    case.goal = case.position
    return case


def noisy_config(**changes: Any) -> PlannerConfig:
    """Return a configuration with limits that hardly ever clip."""
    return config_of(
        "paper", sampling__samples=512, vehicle__mass=10.0, vehicle__thrust_max=1000.0,
        vehicle__rate_xy_max=20.0, vehicle__rate_z_max=20.0, **changes,
    )  # fmt: skip


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_statistics(device: str, correlation: float):
    variance = np.array([2.0, 1.0, 1.0, 0.5])
    config = noisy_config(
        sampling__correlation=correlation, sampling__variance_thrust=2.0, sampling__variance_rate_xy=1.0,
        sampling__variance_rate_z=0.5,
    )  # fmt: skip
    noise = noise_of(Planner(config, device=device, seed=3), resting())
    white = noise.reshape(-1, 25, 4) / np.sqrt(variance)
    # 15 x 512 independent rollouts: five standard errors of a mean are 0.057, of a variance 0.081.
    n = len(white)
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=5 / np.sqrt(n))
    # e_t = rho e_{t-1} + sqrt(1 - rho^2) w_t from e = 0 before the first control.
    spread = 1.0 - correlation ** (2 * np.arange(1, 26)[:, None])
    np.testing.assert_allclose(white.var(axis=0), np.tile(spread, 4), atol=5 * np.sqrt(2 / n))
    for lag in (1, 2, 5):
        together = (white[:, lag:] * white[:, :-lag]).mean(axis=0)
        np.testing.assert_allclose(together, np.tile(correlation**lag * spread[:-lag], 4), atol=5 * np.sqrt(2 / n))
    # Components, instances and neighbouring samples are independent.
    np.testing.assert_allclose((white[..., 0] * white[..., 1]).mean(axis=0), 0.0, atol=5 / np.sqrt(n))
    np.testing.assert_allclose((white[1:, 3] * white[:-1, 3]).mean(axis=0), 0.0, atol=5 / np.sqrt(n))


def test_noise_is_gaussian(device: str):
    """Compare quantiles of 768 000 standard normal numbers, whose standard error is below 0.004."""
    noise = noise_of(Planner(noisy_config(), device=device), resting())[..., 0]
    quantiles = np.quantile(noise, [0.02275, 0.15866, 0.5, 0.84134, 0.97725])
    np.testing.assert_allclose(quantiles, [-2, -1, 0, 1, 2], atol=0.03)


def test_noise_stays_in_its_table(device: str):
    """With this seed the last of the 256 possible first sequences is drawn, 64 before the end of the table."""
    config = noisy_config(anchors__columns=1, anchors__rows=1).replace({"sampling.samples": 1024})
    planner = Planner(config, device=device, seed=166)
    noise = noise_of(planner, resting())[0]
    table = planner.workspace.noise.numpy().transpose(2, 0, 1)
    rows = (len(table) - 64 + np.arange(1024)) % len(table)
    scale = np.sqrt([1.0, 1.0, 1.0, 0.5])
    np.testing.assert_allclose(np.abs(noise), np.abs(table[rows] * scale), atol=1e-4)


def test_each_plan_draws_new_noise(device: str):
    planner, case = Planner(noisy_config(), device=device), resting()
    first, second = noise_of(planner, case), noise_of(planner, case)
    # Unrelated from plan to plan: 5 standard errors of a correlation of 15 x 512 x 25 pairs, unlike 1.
    assert abs((first[..., 1] * second[..., 1]).mean()) < 5 / np.sqrt(15 * 512 * 25)
    planner.reset()
    np.testing.assert_array_equal(noise_of(planner, case), first)


def test_sampled_controls_respect_the_limits(device: str):
    config = config_of(sampling__variance_thrust=100.0, sampling__variance_rate_xy=20.0, sampling__variance_rate_z=20.0)
    planner = Planner(config, device=device)
    plan = random_case(0).plan(planner)
    low, high = np.array([0.3, -3, -3, -2]), np.array([16.35, 3, 3, 2])
    for u in (sampled_controls(planner, plan), plan.controls):
        assert (u >= low - 1e-5).all() and (u <= high + 1e-5).all()
