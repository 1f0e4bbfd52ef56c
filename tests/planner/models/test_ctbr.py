from typing import Any

import numpy as np
import pytest

from aero_planner import Goal, Planner, PlanStatus, VehicleState
from tests.planner import reference
from tests.planner.cases import config_of, random_case


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("changes", [{}, {"vehicle__mass": 1.7, "sampling__dt": 0.11, "vehicle__gravity": 3.7}])
def test_stage2_rollouts_are_rk4(device: str, seed: int, changes: dict[str, Any]):
    config, case = config_of(**changes), random_case(seed, tilt=2.5)
    plan = case.plan(Planner(config, device=device))
    for m in range(len(plan.kinds)):
        x = reference.roll_out(case.position, case.quaternion, case.velocity, plan.controls[m], config)
        # 25 steps, each rounded to 2e-6 m at 30 m (4e-6 beyond 32 m), 5e-7 m/s and 1e-7; attitude errors of 1e-6 turn
        # up to 16 m/s^2 for up to 2.75 s.
        np.testing.assert_allclose(plan.positions[m, 1:], x.p, atol=2e-4)
        np.testing.assert_allclose(plan.velocities[m, 1:], x.v, atol=1e-4)
        np.testing.assert_allclose(plan.quaternions[m, 1:], x.q, atol=5e-6)
    np.testing.assert_array_equal(plan.positions[:, 0], np.tile(case.position, (16, 1)))
    np.testing.assert_array_equal(plan.velocities[:, 0], np.tile(case.velocity, (16, 1)))
    np.testing.assert_allclose(np.linalg.norm(plan.quaternions, axis=-1), 1.0, atol=1e-6)


def test_stage1_rollouts_are_rk4(device: str):
    config, case = config_of(), random_case(0)
    planner = Planner(config, device=device)
    plan = case.plan(planner, samples=True)
    assert plan.samples is not None and plan.samples.shape == (16, 16, 26, 3)
    controls = planner.workspace.sample_controls.numpy()[..., :16].swapaxes(2, 3)
    for m, k in [(0, 0), (7, 5), (14, 15), (15, 3)]:
        x = reference.roll_out(case.position, case.quaternion, case.velocity, controls[m, :, k], config)
        np.testing.assert_allclose(plan.samples[m, k, 1:], x.p, atol=1e-4)
        np.testing.assert_array_equal(plan.samples[m, k, 0], case.position)


def test_quaternions_need_not_be_unit(device: str):
    case, planner = random_case(0), Planner(config_of(), device=device)
    one = case.plan(planner)
    planner.reset()
    case.quaternion = 4.0 * case.quaternion  # a power of two: the normalised quaternion has the same bits
    np.testing.assert_array_equal(case.plan(planner).controls, one.controls)


LAGS: dict[str, Any] = {"vehicle__thrust_lag": 0.045, "vehicle__rate_lag": 0.07}


@pytest.mark.parametrize("elapsed", [0.0, 0.02, 0.13])
def test_controls_lag_behind_the_commands(device: str, elapsed: float):
    config, case = config_of(**LAGS), random_case(1)
    dt = config.sampling.dt
    planner = Planner(config, device=device)
    control = reference.hover(config)
    for time in (5.0, 5.0 + elapsed):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        plan = planner.plan(state, Goal(case.goal), case.points)
        np.testing.assert_allclose(planner.workspace.control.numpy()[0], control, atol=2e-5)
        for m in range(len(plan.kinds)):
            if plan.status != PlanStatus.OK and m == plan.best:
                continue  # the first control of a proven stop is the mean until the next plan
            x = reference.roll_out(case.position, case.quaternion, case.velocity, plan.controls[m], config, control)
            np.testing.assert_allclose(plan.positions[m, 1:], x.p, atol=2e-4)
            np.testing.assert_allclose(plan.quaternions[m, 1:], x.q, atol=5e-6)
        # The second plan starts from the control to which the first one has led.
        left, step = elapsed, 0
        while left > 1e-9:
            _, control = reference.follow(control, plan.command[step].astype(float), min(left, dt), config)
            left, step = left - dt, step + 1
    control = planner.workspace.control.numpy()[0].astype(np.float64)
    plan = planner.plan(state, Goal(case.goal), case.points, samples=True)  # at the same time: the same control
    assert plan.samples is not None
    commands = planner.workspace.sample_controls.numpy()[..., :16].swapaxes(2, 3)
    x = reference.roll_out(case.position, case.quaternion, case.velocity, commands[3, :, 5], config, control)
    np.testing.assert_allclose(plan.samples[3, 5, 1:], x.p, atol=2e-4)


def test_the_lagged_model_agrees_with_its_differential_equation():
    """A step takes the mean of the control; small steps of the equation itself hardly differ."""
    config, case = config_of(**LAGS), random_case(2)
    rng = np.random.default_rng(0)
    commands = reference.hover(config) + rng.normal(size=(25, 4))
    coarse = reference.roll_out(case.position, case.quaternion, case.velocity, commands, config)
    fine = config.replace({"sampling.dt": config.sampling.dt / 9.0})
    exact = reference.roll_out(case.position, case.quaternion, case.velocity, np.repeat(commands, 9, axis=0), fine)
    assert np.linalg.norm(coarse.p - exact.p[8::9], axis=1).max() < 0.02
    assert np.linalg.norm(coarse.v - exact.v[8::9], axis=1).max() < 0.05


def test_nominal_controls_for_a_lag_do_not_let_the_drone_oscillate(device: str):
    """A drone with a lag that obeys the newest plan settles; controls for one without a lag make it roll about."""
    changes = {}
    for lag in (0.07, 0.0):
        config = config_of("paper", anchors__lookahead=0.3, vehicle__rate_lag=lag,
                           sampling__variance_thrust=0.0, sampling__variance_rate_xy=0.0,
                           sampling__variance_rate_z=0.0)  # fmt: skip
        planner = Planner(config, device=device)
        drone = config.replace({"vehicle.rate_lag": 0.07, "sampling.dt": 0.02})
        q, control, rolls = np.array([0.97, 0.24, 0.0, 0.0]), reference.hover(config), []
        for tick in range(50):
            state = VehicleState(np.zeros(3), np.zeros(3), q, np.zeros(3), time=5.0 + 0.02 * tick)
            command = planner.plan(state, Goal(np.zeros(3)), np.zeros((0, 3), np.float32)).command[0].astype(float)
            mean, control = reference.follow(control, command, 0.02, drone)
            q = reference.rk4(np.concatenate((np.zeros(3), q, np.zeros(3))), mean, drone)[3:7]
            rolls.append(command[1])
        signs = np.sign(rolls)[np.abs(rolls) > 0.05]
        changes[lag] = int((np.diff(signs) != 0).sum())
    assert changes[0.07] <= 2 < 4 <= changes[0.0]
