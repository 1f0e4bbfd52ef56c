"""The state at which a plan takes effect."""

import numpy as np

from aero_planner import Goal, Planner, VehicleState
from tests.planner import reference
from tests.planner.cases import config_of, level_case, random_case


def test_plans_start_from_the_state_after_the_delay(device: str):
    case, planner = random_case(3, count=0), Planner(config_of(vehicle__delay=0.1), device=device)
    plan = case.plan(planner)  # without a previous plan the drone hovers until then
    config = planner.config.replace({"sampling.dt": 0.01})
    hover = np.tile([config.vehicle.mass * config.vehicle.gravity, 0.0, 0.0, 0.0], (10, 1))
    x = reference.roll_out(case.position, reference.unit(case.quaternion), case.velocity, hover, config)
    np.testing.assert_allclose(plan.positions[0, 0], x.p[-1], atol=1e-5)
    np.testing.assert_allclose(plan.velocities[0, 0], x.v[-1], atol=1e-5)


LAGS = {"vehicle.thrust_lag": 0.05, "vehicle.rate_lag": 0.07}


def test_the_prediction_follows_the_commands_of_the_previous_plan_with_the_lags(device: str):
    config = config_of(vehicle__delay=0.1).replace(LAGS)
    case, planner = level_case(speed=3.0), Planner(config, device=device)

    def plan(time: float):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal([3.0, 8.0, 4.0]), case.points)

    command = plan(0.0).command.astype(np.float64)
    second = plan(0.1)  # the commands sent until now arrive from now on
    sent = 0.01 * (np.arange(10) + 0.5) / config.sampling.dt
    arriving = np.stack([np.interp(sent, np.arange(len(command)), u) for u in command.T], axis=1)
    fine = config.replace({"sampling.dt": 0.01})
    x = reference.roll_out(case.position, case.quaternion, case.velocity, arriving, fine)
    np.testing.assert_allclose(second.positions[0, 0], x.p[-1], atol=1e-4)
    np.testing.assert_allclose(second.velocities[0, 0], x.v[-1], atol=1e-3)
    np.testing.assert_allclose(second.quaternions[0, 0], x.q[-1], atol=1e-4)
