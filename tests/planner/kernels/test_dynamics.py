from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aero_planner import Goal, Planner, VehicleState
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
    np.testing.assert_array_equal(plan.positions[:, 0], np.tile(case.position, (17, 1)))
    np.testing.assert_array_equal(plan.velocities[:, 0], np.tile(case.velocity, (17, 1)))
    np.testing.assert_allclose(np.linalg.norm(plan.quaternions, axis=-1), 1.0, atol=1e-6)


def test_stage1_rollouts_are_rk4(device: str):
    config, case = config_of(), random_case(0)
    planner = Planner(config, device=device)
    plan = case.plan(planner, samples=True)
    assert plan.samples is not None and plan.samples.shape == (17, 16, 26, 3)
    controls = planner.workspace.sample_controls.numpy()[..., :16].swapaxes(2, 3)
    for m, k in [(0, 0), (7, 5), (15, 15), (16, 3)]:
        x = reference.roll_out(case.position, case.quaternion, case.velocity, controls[m, :, k], config)
        np.testing.assert_allclose(plan.samples[m, k, 1:], x.p, atol=1e-4)
        np.testing.assert_array_equal(plan.samples[m, k, 0], case.position)


def test_quaternions_need_not_be_unit(device: str):
    config = config_of(sampling__fresh_noise=False, candidates__previous=False)
    case, planner = random_case(0), Planner(config, device=device)
    one = case.plan(planner)
    case.quaternion = 4.0 * case.quaternion  # a power of two: the normalised quaternion has the same bits
    np.testing.assert_array_equal(case.plan(planner).controls, one.controls)


def test_hover_stays(device: str):
    config = config_of("paper", sampling__nominal="hover", sampling__variance_thrust=0.0,
                       sampling__variance_rate_xy=0.0, sampling__variance_rate_z=0.0)  # fmt: skip
    case = random_case(0, count=0, tilt=0.0)
    planner = Planner(config, device=device)
    state = VehicleState(case.position, np.zeros(3), case.quaternion)
    plan = planner.plan(state, Goal(case.goal), case.points)
    np.testing.assert_allclose(plan.positions, np.broadcast_to(case.position, plan.positions.shape), atol=1e-4)
