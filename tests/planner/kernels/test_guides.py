import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, PlannerConfig, VehicleState
from aero_planner.kernels.guides import BRAKING_FAN
from tests.planner import reference
from tests.planner.cases import PERIOD, config_of, random_case

SEEDS = range(4)


def nominal(planner: Planner) -> np.ndarray:
    """Return the nominal controls of the last plan, shape [M, N, 4]."""
    return planner.workspace.nominal_controls.numpy()[0, : len(planner.config.kinds)]


def end_velocities(plan: Plan, config: PlannerConfig) -> np.ndarray:
    """Return the velocities at the ends of the guides [m/s], shape [M, 3]."""
    return plan.guide_coefficients @ np.array([k * config.horizon ** max(k - 1, 0) for k in range(6)])


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", SEEDS)
def test_guides_solve_the_boundary_conditions(device: str, preset: str, seed: int):
    config, case = config_of(preset), random_case(seed)
    plan = case.plan(Planner(config, device=device))
    times = np.arange(config.sampling.steps + 1) * config.sampling.dt
    rest = np.zeros(3)
    for m in range(len(plan.kinds)):
        end = plan.anchors[m].astype(np.float64)
        expected = reference.quintic(case.position, case.velocity, case.acceleration, end, rest, config.horizon)
        # Coefficients c_k scale as 1/T^k of 15 x 40 m at 1e-7, and the endpoint itself is rounded to 2e-6 m.
        np.testing.assert_allclose(plan.guide_coefficients[m], expected, rtol=1e-4, atol=3e-4)
        np.testing.assert_allclose(plan.guides[m], reference.sample_guide(expected, times), atol=2e-4)


def test_guides_that_reach_the_goal_take_its_velocity(device: str):
    case = random_case(0, count=0)
    goal = case.beside(1.0, 0.2, 0.0)
    velocity = np.array([0.5, -0.25, 0.125])
    config = config_of("paper")
    plan = Planner(config, device=device).plan(case.state, Goal(goal, velocity), case.points)
    np.testing.assert_allclose(end_velocities(plan, config), np.tile(velocity, (15, 1)), atol=2e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_nominal_controls_correct_a_tilted_start(device: str, seed: int):
    """From a tilt of up to 40 deg against the guide, the controls recover within the horizon."""
    config = config_of("paper", anchors__lookahead=1.5)
    case = random_case(seed, speed=0.0)
    case.velocity, case.acceleration = np.zeros(3), np.zeros(3)
    planner = Planner(config, device=device)
    case.plan(planner)
    for u in nominal(planner):
        x = reference.roll_out(case.position, case.quaternion, case.velocity, u, config)
        assert reference.rotation(x.q[-1])[2, 2] > np.cos(0.3)


@pytest.mark.parametrize("seed", SEEDS)
def test_nominal_controls_turn_the_nose_evenly_to_the_goal(device: str, seed: int):
    config, case = config_of("paper", anchors__lookahead=1.0), random_case(seed, tilt=0.0)
    case.velocity, case.acceleration = np.zeros(3), np.zeros(3)
    planner = Planner(config, device=device)
    case.plan(planner)
    R, q_goal = reference.rotation(reference.unit(case.quaternion)), case.full_goal()[2]
    turn = np.arctan2(*reference.rotation(q_goal)[[1, 0], 0]) - np.arctan2(R[1, 0], R[0, 0])
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    limit = config.vehicle.rate_z_max
    np.testing.assert_allclose(nominal(planner)[..., 3], np.clip(turn / config.horizon, -limit, limit), atol=1e-5)


@pytest.mark.parametrize("preset", ["default", "px4"])
def test_nominal_controls_follow_the_guide_from_the_control_in_effect(device: str, preset: str):
    config, case = config_of(preset), random_case(3, tilt=0.3)
    planner = Planner(config, device=device)
    case.plan(planner)
    plan = case.plan(planner)  # 0.02 s later
    control, command = (getattr(planner.workspace, name).numpy()[0].astype(float) for name in ("control", "command"))
    q_goal, R = case.full_goal()[2], reference.rotation(reference.unit(case.quaternion))
    turn = 2.0 * np.arctan2(q_goal[3], q_goal[0]) - np.arctan2(R[1, 0], R[0, 0])
    yaw_rate = ((turn + np.pi) % (2 * np.pi) - np.pi) / config.horizon
    assert np.abs(control[1:3]).max() > 0.1
    for m in range(config.anchor_count):
        coefficients = plan.guide_coefficients[m].astype(np.float64)
        before = command if config.costs.q_control_jump else None
        expected = reference.follow_guide(coefficients, case.quaternion, yaw_rate, control, config, command=before)
        np.testing.assert_allclose(nominal(planner)[m], expected, atol=2e-3)


def test_nominal_controls_respect_the_limits(device: str):
    config = config_of(vehicle__rate_xy_max=1.0, vehicle__rate_z_max=0.2, vehicle__thrust_max=12.0)
    planner = Planner(config, device=device)
    for seed in SEEDS:
        random_case(seed, speed=8.0).plan(planner)
        u = nominal(planner)
        # Interpolating the previous controls may round past a limit, which sampling clamps anyway.
        assert np.abs(u[..., 1:3]).max() <= 1.00001 and np.abs(u[..., 3]).max() <= 0.20001
        assert u[..., 0].max() <= 12.0001 and u[..., 0].min() >= 0.29999


@pytest.mark.parametrize("reach", [0.1, 0.35, 0.9])
def test_braking_guides_fan_out_and_end_at_rest_within_their_reach(device: str, reach: float):
    config, case = config_of(candidates__brake_reach=reach), random_case(0)
    planner = Planner(config, device=device)
    case.plan(planner)
    times = np.arange(config.sampling.steps + 1) * config.sampling.dt
    nominal_controls = planner.workspace.nominal_controls.numpy()[0]
    for k, angle in enumerate(np.radians([0.0, 30.0, -30.0, 60.0, -60.0])):
        row, (x, y, z) = len(config.kinds) + k, case.velocity
        turned = np.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z])
        end = case.position + reach * config.horizon * turned
        np.testing.assert_allclose(planner.outputs.anchors.numpy()[0, row], end, atol=1e-5)
        guide = reference.quintic(case.position, case.velocity, case.acceleration, end, np.zeros(3), config.horizon)
        np.testing.assert_allclose(
            planner.outputs.guides.numpy()[0, row], reference.sample_guide(guide, times), atol=1e-4
        )
        # The nose keeps its heading.
        expected = reference.follow_guide(guide, case.quaternion, 0.0, reference.hover(config), config)
        np.testing.assert_allclose(nominal_controls[row], expected, atol=2e-3)
    assert int(BRAKING_FAN) == 5


def shifted(controls: np.ndarray, shift: float, hover: np.ndarray) -> np.ndarray:
    """Return the controls from `shift` time steps on, interpolated, and hover past their end."""
    padded = np.concatenate((controls, np.tile(hover, (len(controls) + 2, 1))))
    times = np.arange(len(controls)) + shift
    return np.stack([np.interp(times, np.arange(len(padded)), padded[:, i]) for i in range(4)], axis=1)


@pytest.mark.parametrize("elapsed", [0.0, 0.02, 0.05, 0.13, 1.11])
def test_previous_plan_is_shifted_by_the_elapsed_time(device: str, elapsed: float):
    config, case = config_of(), random_case(0)
    planner = Planner(config, device=device)
    # Stamps as they come, in seconds since 1970.
    stamp = 1.7e9
    first = planner.plan(_at(case, stamp), Goal(case.goal), case.points)
    second = planner.plan(_at(case, stamp + elapsed), Goal(case.goal), case.points)
    m = second.kinds.index("previous")
    hover = np.array([config.vehicle.mass * config.vehicle.gravity, 0, 0, 0])
    expected = shifted(first.command.astype(np.float64), elapsed / config.sampling.dt, hover)
    # float64 stamps of 1.7e9 s resolve 2e-7 s, 5e-6 steps, between controls up to 16 apart.
    np.testing.assert_allclose(nominal(planner)[m], expected, atol=2e-4)
    np.testing.assert_array_equal(second.anchors[m], first.positions[first.best, -1])


def _at(case, time: float | None) -> VehicleState:
    return VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)


def test_states_without_time_are_a_period_apart(device: str):
    config, case = config_of(), random_case(0)
    planner = Planner(config, device=device)
    first = case.plan(planner)
    case.plan(planner)
    hover = np.array([config.vehicle.mass * config.vehicle.gravity, 0, 0, 0])
    expected = shifted(first.command.astype(np.float64), PERIOD / config.sampling.dt, hover)
    np.testing.assert_allclose(nominal(planner)[15], expected, atol=2e-5)


@pytest.mark.parametrize("elapsed", [-0.1, 1.25, 100.0])
def test_a_previous_plan_of_another_time_is_not_used(device: str, elapsed: float):
    """The candidate is then a guide toward the goal, as in the first plan."""
    case, planner = random_case(0), Planner(config_of(way_out__q_escape=0.0), device=device)
    planner.plan(_at(case, 50.0), Goal(case.goal), case.points)
    before = nominal(planner).copy()
    planner.plan(_at(case, 50.0 + elapsed), Goal(case.goal), case.points)
    np.testing.assert_array_equal(nominal(planner), before)
    toward = reference.unit(case.goal - case.position)
    anchor = planner.outputs.anchors.numpy()[0, 15]  # a plan shows what has replaced the best instance
    assert reference.unit(anchor - case.position) @ toward == pytest.approx(1.0, abs=1e-6)
