import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import Planner
from tests.planner import reference
from tests.planner.cases import assert_same, batch_of, config_of, kept_points, random_case


def check_against_brute_force(planner: Planner, case, config) -> None:
    plan = case.plan(planner)
    d_max = config.costs.distance_max
    positions = plan.positions[:, 1:].reshape(-1, 3).astype(np.float64)
    expected = reference.clearance(positions, kept_points(plan), d_max).reshape(plan.clearance.shape)
    # Differences of coordinates up to 30 m plus 20 m of flight: 4e-6 m each.
    np.testing.assert_allclose(plan.clearance, expected, atol=2e-5)
    cost: np.ndarray = planner.workspace.sample_clearance_cost.numpy()
    samples = planner.workspace.sample_positions.numpy()[..., : cost.shape[2]].swapaxes(2, 3).astype(np.float64)
    steps, costs = config.sampling.steps, config.costs
    flown = reference.clearance(samples[:, :steps].reshape(-1, 3)[::7], kept_points(plan), d_max)
    away = (np.abs(flown[:, None] - (costs.distance_min, d_max)) > 1e-4).all(axis=1)  # from steps of the cost
    expected = reference.J_col(flown, config)
    # 2e-5 m at the steepest slope, which is penalty / d_min or decay x penalty.
    slope = costs.penalty * max(costs.decay, 1.0 / costs.distance_min) + costs.soft_weight / (
        d_max - costs.distance_min
    )
    np.testing.assert_allclose(cost[:, :steps].reshape(-1)[::7][away], expected[away], atol=4e-5 * slope, rtol=1e-5)
    if costs.q_blocked > 0.0:
        probed = reference.clearance(samples[:, steps:].reshape(-1, 3)[::7], kept_points(plan), 10.0)
        away = np.abs(probed - costs.distance_min) > 1e-4
        np.testing.assert_array_equal(
            cost[:, steps:].reshape(-1)[::7][away], (probed < costs.distance_min)[away].astype(np.float32)
        )


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", range(3))
def test_clearance_is_exact(device: str, preset: str, seed: int):
    config = config_of(preset)
    check_against_brute_force(Planner(config, device=device), random_case(seed, count=800, nearest=0.3), config)


_PLANNERS: dict[str, Planner] = {}


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    range_max=st.floats(1.0, 25.0),
    distance_max=st.floats(0.06, 5.0),
    distance_min=st.floats(0.1, 0.9),
    safe_clearance=st.floats(0.0, 5.0),
    speed=st.floats(0.0, 30.0),
)
def test_clearance_is_exact_for_any_grid(
    device: str,
    seed: int,
    range_max: float,
    distance_max: float,
    distance_min: float,
    safe_clearance: float,
    speed: float,
):
    """Vary the width of the cells, and let rollouts leave the grid; `distance_min` is a share of `distance_max`."""
    config = config_of(
        partition__range_max=range_max, costs__distance_max=distance_max,
        costs__distance_min=distance_min * distance_max, candidates__safe_clearance=safe_clearance, sampling__samples=8,
    )  # fmt: skip
    planner = _PLANNERS.setdefault(device, Planner(config, device=device))
    planner.configure(config)
    case = random_case(seed, count=400, nearest=0.2, speed=speed)
    check_against_brute_force(planner, case, config)


def test_points_on_the_rim_of_the_grid(device: str):
    """Points at exactly range_max along the axes, queried from both sides of the last cells of the grid."""
    config = config_of("paper", partition__range_max=2.0)
    case = random_case(0, count=0)
    case.position, case.quaternion, case.velocity = np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([3.0, 0, 0])
    case.goal = np.array([30.0, 0, 0])
    case.points = np.concatenate((np.eye(3), -np.eye(3))).astype(np.float32) * 2
    plan = case.plan(Planner(config, device=device))
    assert len(kept_points(plan)) == 6
    expected = reference.clearance(plan.positions[:, 1:].reshape(-1, 3).astype(np.float64), kept_points(plan), 1.0)
    np.testing.assert_allclose(plan.clearance.ravel(), expected, atol=2e-5)
    assert (plan.clearance < 1.0).any() and (np.abs(plan.positions) > 2.6).any()


@pytest.mark.parametrize("seed", range(3))
def test_the_ground_counts_as_an_obstacle(device: str, seed: int):
    """The ground also counts where there is no point, and beyond the grid."""
    case = random_case(seed, count=300 * seed, nearest=0.5)
    ground = float(case.position[2]) - 0.2
    config = config_of(candidates__prefer_safe=False)
    plan = case.plan(Planner(config, device=device), ground_height=ground)
    x = plan.positions[:, 1:].astype(np.float64)
    to_points = reference.clearance(x.reshape(-1, 3), kept_points(plan), 0.55).reshape(plan.clearance.shape)
    expected = np.minimum(to_points, np.maximum(x[..., 2] - ground, 0.0))
    np.testing.assert_allclose(plan.clearance, expected, atol=2e-5)
    assert (plan.clearance < to_points - 0.01).any()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_ground_that_is_unknown_or_not_used_changes_nothing(device: str, preset: str):
    case = random_case(0, count=300, nearest=0.5)
    ground = float(case.position[2]) - 0.2
    expected = case.plan(Planner(config_of(preset, costs__use_ground=False), device=device))
    assert_same(expected, case.plan(Planner(config_of(preset, costs__use_ground=True), device=device)))
    unused = Planner(config_of(preset, costs__use_ground=False), device=device)
    assert_same(expected, case.plan(unused, ground_height=ground))


def test_each_drone_of_a_batch_has_its_own_ground(device: str):
    cases = [random_case(seed, nearest=0.5) for seed in range(3)]
    heights = np.array([cases[0].position[2] - 0.2, -np.inf, cases[2].position[2] - 1.0])
    together = Planner(config_of(), device=device, batch=3).plan(*batch_of(cases), ground_height=heights)
    for b, (case, height) in enumerate(zip(cases, heights, strict=True)):
        known = None if np.isinf(height) else height
        alone = case.plan(Planner(config_of(), device=device, seed=b), ground_height=known)
        np.testing.assert_array_equal(together.controls[b], alone.controls)
        np.testing.assert_array_equal(together.clearance[b], alone.clearance)


def test_nothing_dives_to_unseen_ground(device: str):
    """For a goal ahead and 2 m below, the plan leads there only if the ground is unknown."""
    case = random_case(0, count=0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.array([3.0, 0, -2.0]), np.zeros(3), case.beside(6, 0, -2.0)
    lowest = []
    for ground in (None, float(case.position[2]) - 1.0):
        plan = case.plan(Planner(config_of(), device=device), ground_height=ground)
        lowest.append(plan.positions[plan.best, :, 2].min() - case.position[2])
    assert lowest[0] < -0.75 < lowest[1]


@pytest.mark.parametrize(
    ("height", "flown_to", "changes"),
    [
        (-3.0, -1.0 + 0.55, {}),
        (9.0, 4.0 - 0.55, {}),
        (-3.0, -2.0 + 0.55, {"costs__use_ground": False}),
        (9.0, 1.4, {"costs__height_min": 1.0, "costs__height_max": 1.8}),
    ],
)
def test_a_goal_at_a_height_that_is_not_free_counts_as_the_nearest_free_place(
    device: str, height: float, flown_to: float, changes: dict[str, float]
):
    """In a band that is too low for d_max on both sides, that is its middle."""
    case = random_case(0, count=0, tilt=0.0)
    case.position, plans = np.array([0.0, 0.0, 1.375]), []
    config = config_of("default", **{"costs__height_min": -2.0, "costs__height_max": 4.0, **changes})
    for z in (height, flown_to):
        case.goal = np.array([6.0, 2.0, z])
        plans.append(case.plan(Planner(config, device=device), ground_height=-1.0))
    np.testing.assert_allclose(plans[0].initial_endpoints, plans[1].initial_endpoints, atol=1e-5)
    np.testing.assert_allclose(plans[0].goal_cost, plans[1].goal_cost, rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_the_ends_of_the_band_of_heights_count_as_obstacles(device: str, seed: int):
    """Also where there is no point, beyond the grid, and out of the band, where nothing is clear."""
    case = random_case(seed, count=300 * seed, nearest=0.5)
    low, high = float(case.position[2]) - 0.3, float(case.position[2]) + 0.4
    config = config_of(candidates__prefer_safe=False, costs__height_min=low, costs__height_max=high)
    plan = case.plan(Planner(config, device=device))
    x = plan.positions[:, 1:].astype(np.float64)
    to_points = reference.clearance(x.reshape(-1, 3), kept_points(plan), 0.55).reshape(plan.clearance.shape)
    to_ends = np.minimum(x[..., 2] - low, high - x[..., 2])
    np.testing.assert_allclose(plan.clearance, np.minimum(to_points, np.maximum(to_ends, 0.0)), atol=2e-5)
    for limits in (x[..., 2] - low, high - x[..., 2]):
        assert ((limits > 0.0) & (plan.clearance < to_points - 0.01) & (limits == to_ends)).any()
    assert (plan.clearance[to_ends < 0.0] == 0.0).all() and (to_ends < 0.0).any()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_plans_stay_in_the_band_of_heights(device: str, side: float):
    """For a goal ahead and out of the band, the plan leads out of it only if there is none."""
    case = random_case(0, count=0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.array([3.0, 0, 0]), np.zeros(3), case.beside(6, 0, 4.0 * side)
    end, unlimited = float(case.position[2]) + 0.75 * side, config_of()
    limited = unlimited.replace({"costs.height_min" if side < 0.0 else "costs.height_max": end})
    farthest = []
    for config in (unlimited, limited):
        plan = case.plan(Planner(config, device=device))
        farthest.append((side * (plan.positions[plan.best, :, 2] - end)).max())
    assert farthest[1] < -0.2 and farthest[0] > 0.0
