"""Compare the planner with the naive reference, stage by stage and as a whole."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, VehicleState
from aero_planner.config import Value
from benchmarks.naive import NEUTRAL, NaivePlanner, mppi
from tests.planner.cases import Case, random_case
from tests.planner.cases import config_of as small_config

Arrays = dict[str, NDArray[Any]]

# Both sides sum some 200 float32 terms per rollout, over states that agree to 1e-5 m.
COST: dict[str, Any] = {"rtol": 5e-5, "atol": 1e-2}
EDGE = 3e-5
"""Distance to a step of a penalty within which rounding may put a state on its other side [m]."""


def config_of(preset: str = "default", **changes: Value) -> PlannerConfig:
    """Return a preset with few samples and `changes`, without the options that the naive kernels lack."""
    return small_config(preset, **changes).replace(NEUTRAL)


def both(
    device: str, case: Case, preset: str = "default", *, plans: int = 2, **changes: Value
) -> tuple[PlannerConfig, Plan, Arrays]:
    """Return the `plans`-th plan of both, from the same history; the second one has a previous plan."""
    config = config_of(preset, **changes)
    planner = Planner(config, device=device, seed=7)
    naive = NaivePlanner(planner)
    for _ in range(plans - 1):
        case.plan(planner)
    naive.take_over()
    plan = case.plan(planner)
    naive.run()
    planner.close()
    return config, plan, naive.result()


def untouched(plan: Plan, config: PlannerConfig) -> NDArray[np.bool_]:
    """Return the instances that no braking candidate has replaced, as a mask."""
    kept = np.array(plan.kinds) == np.array(config.kinds)
    if plan.status != PlanStatus.OK:
        kept[plan.best] = False
    return kept


def away_from_penalty_steps(naive: Arrays, config: PlannerConfig) -> NDArray[np.bool_]:
    """Return the samples [M, K] without a state that rounding may move across a step of the penalties, as a mask."""
    c, N, d = config.costs, config.sampling.steps, naive["sample_distance"]

    def at(edge: float, d: NDArray[Any]) -> NDArray[np.bool_]:
        # A distance that is truncated at the edge lies beyond it.
        return np.any((np.abs(d - edge) < EDGE) & (d != np.float32(edge)), axis=-1)

    touching = at(c.distance_min, d[..., :N]) | at(c.distance_max, d[..., :N])
    if c.q_blocked > 0.0:
        touching |= at(c.blocked_radius, d[..., N:])
    return np.logical_not(touching)


def check_partition(plan: Plan, naive: Arrays) -> None:
    np.testing.assert_array_equal(plan.fine_range.ravel(), naive["fine_range"][0])
    kept = naive["filtered"][0, : naive["count"][0]]
    assert isinstance(plan.filtered_points, np.ndarray)
    np.testing.assert_array_equal(np.unique(plan.filtered_points, axis=0), np.unique(kept, axis=0))
    assert len(plan.filtered_points) == len(kept)
    assert plan.dropped_points == naive["dropped"][0]
    np.testing.assert_array_equal(plan.safe_range.ravel(), naive["safe_range"][0])
    np.testing.assert_allclose(plan.safe_direction.reshape(-1, 3), naive["safe_direction"][0], atol=1e-6)


def check_costs(config: PlannerConfig, plan: Plan, naive: Arrays) -> None:
    comparable = away_from_penalty_steps(naive, config) & untouched(plan, config)[:, None]
    assert comparable.mean() > 0.8
    np.testing.assert_allclose(plan.stage1_cost[comparable], naive["cost"][comparable], **COST)


def check_choice(plan: Plan, naive: Arrays) -> None:
    assert (plan.best, int(plan.status)) == (naive["best"][0], naive["status"][0])
    np.testing.assert_allclose(plan.command, naive["controls"][0, plan.best], atol=2e-3)
    np.testing.assert_allclose(plan.positions[plan.best], naive["states"][0, plan.best], atol=5e-4)


def check_all(config: PlannerConfig, plan: Plan, naive: Arrays) -> None:
    check_partition(plan, naive)
    np.testing.assert_allclose(plan.anchors, naive["anchor"][0, : len(plan.kinds)], atol=1e-5)
    np.testing.assert_allclose(plan.guides, naive["guide"][0, : len(plan.kinds)], atol=3e-5)
    check_costs(config, plan, naive)
    check_choice(plan, naive)


@pytest.mark.parametrize("preset", ["default", "paper", "px4"])
@pytest.mark.parametrize("seed", range(4))
def test_random_clouds_and_states(device: str, preset: str, seed: int):
    nearest, speed = (0.3, 0.6, 1.0, 1.5)[seed], (4.0, 9.0)[seed % 2]
    check_all(*both(device, random_case(seed, count=1000 * (seed + 1), nearest=nearest, speed=speed), preset))


@pytest.mark.parametrize("seed", range(4))
def test_tilted_and_overturned_attitudes(device: str, seed: int):
    check_all(*both(device, random_case(seed + 20, nearest=0.8, tilt=np.pi)))


def test_first_plan_has_no_previous_one(device: str):
    check_all(*both(device, random_case(11), plans=1))


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_empty_cloud(device: str, preset: str):
    config, plan, naive = both(device, random_case(1, count=0), preset)
    check_all(config, plan, naive)
    assert naive["count"][0] == 0 and (naive["fine_range"] == 10.0).all()


def test_points_that_are_far_or_not_finite(device: str):
    rng, case = np.random.default_rng(3), random_case(3)
    bad = np.full((60, 3), np.nan, np.float32)
    bad[20:40] = case.points[:20]
    bad[np.arange(20, 40), rng.integers(3, size=20)] = rng.choice([np.inf, -np.inf, np.nan], 20)
    bad[40:] = rng.choice([-1.0, 1.0], (20, 3)) * np.logspace(2, 38, 20)[:, None]
    case.points = rng.permutation(np.concatenate((case.points, bad)))
    config, plan, naive = both(device, case)
    check_all(config, plan, naive)
    assert plan.dropped_points == 40


@pytest.mark.parametrize("seed", range(3))
def test_rollouts_that_leave_the_grid(device: str, seed: int):
    """Some positions beyond range_max are within d_max of a point at the rim."""
    case = random_case(seed + 30, count=4000, nearest=0.8, speed=8.0)
    config, plan, naive = both(device, case, partition__range_max=2.0, costs__distance_max=0.9)
    check_all(config, plan, naive)
    outside = np.linalg.norm(plan.positions - case.position, axis=2)[:, 1:] > 2.05
    assert (outside & (plan.clearance < 0.9)).any()


@pytest.mark.parametrize("samples", [1, 33, 100])
def test_samples_that_fill_no_vector(device: str, samples: int):
    check_all(*both(device, random_case(12, nearest=0.8), sampling__samples=samples, sampling__steps=11))


def test_many_points(device: str):
    """There are so many points that most lie close to a border of their cell."""
    _, plan, naive = both(device, random_case(5, count=200_000), plans=1)
    check_partition(plan, naive)
    assert naive["count"][0] > 5000


@pytest.mark.parametrize("goal_ahead", [0.0, 2.0])
def test_goal_within_the_look_ahead(device: str, goal_ahead: float):
    case = random_case(8, count=500, nearest=1.5)
    case.goal = case.beside(goal_ahead, 0.25, 0.0)
    check_all(*both(device, case))


def test_braking_with_an_old_cloud(device: str):
    config, case = config_of(), random_case(4)
    planner = Planner(config, device=device)
    naive = NaivePlanner(planner)
    plan = case.plan(planner, cloud_age=1.0)
    naive.run()
    check_all(config, plan, naive.result())
    assert plan.status == PlanStatus.STALE_CLOUD


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_braking_where_none_is_safe(device: str, preset: str):
    config, plan, naive = both(device, random_case(5, count=3000, nearest=1.0, speed=9.0), preset, plans=1)
    check_all(config, plan, naive)
    assert plan.status == PlanStatus.NO_SAFE_CANDIDATE and plan.kinds[plan.best] == "brake"
    assert naive["source"][0] >= len(plan.kinds)


def test_batch_of_two(device: str):
    config = config_of()
    cases = [random_case(1, count=500), random_case(2, count=900)]
    planner = Planner(config, device=device, seed=3, batch=2)
    naive = NaivePlanner(planner)
    state = VehicleState(*(np.stack([getattr(case, name) for case in cases])
                           for name in ("position", "velocity", "quaternion", "acceleration")))  # fmt: skip
    plan = planner.plan(state, Goal(np.stack([case.goal for case in cases])), [case.points for case in cases])
    naive.run()
    result = naive.result()
    M = len(config.kinds)
    np.testing.assert_array_equal(plan.fine_range.reshape(2, -1), result["fine_range"])
    np.testing.assert_array_equal(plan.best, result["best"])
    np.testing.assert_array_equal(plan.status, result["status"])
    same = away_from_penalty_steps(result, config).reshape(2, M, -1)
    for b in range(2):
        if result["status"][b] != PlanStatus.OK:
            same[b, result["best"][b]] = False
        assert len(plan.filtered_points[b]) == result["count"][b]
    assert same.mean() > 0.8
    np.testing.assert_allclose(plan.stage1_cost[same], result["cost"].reshape(same.shape)[same], **COST)


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", range(3))
def test_clearance_at_the_same_positions(device: str, preset: str, seed: int):
    """The same positions have the same clearance, up to the rounding of the squared distance."""
    config, case = config_of(preset), random_case(seed, count=1500, nearest=0.3)
    planner = Planner(config, device=device)
    naive = NaivePlanner(planner)
    plan = case.plan(planner, ground_height=float(case.position[2]) - 1.0)
    naive.run()
    a, M, N = naive.arrays, len(plan.kinds), config.sampling.steps
    positions = a.positions.numpy()
    positions[:M, 0, :N] = plan.positions[:, 1:]
    a.positions.assign(positions)
    wp.launch(
        mppi.clearance, dim=a.distance.shape, device=device, inputs=[a.controls.shape[1], a, a.positions, a.distance]
    )
    expected = np.minimum(a.distance.numpy()[:M, 0, :N], np.float32(config.costs.distance_max))
    np.testing.assert_allclose(plan.clearance, expected, rtol=3e-7)
    assert (plan.clearance < config.costs.distance_max).sum() > 20


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", range(3))
def test_update_from_the_same_costs(device: str, preset: str, seed: int):
    """The softmin turns a rounding error of a large cost into another weight, so both use the planner's costs."""
    config, case = config_of(preset, sampling__samples=64), random_case(seed, nearest=1.0, count=400)
    planner = Planner(config, device=device)
    naive = NaivePlanner(planner)
    plan = case.plan(planner)
    naive.run()
    naive.arrays.cost.assign(plan.stage1_cost)
    naive.run(first="update")
    kept = untouched(plan, config)
    np.testing.assert_allclose(plan.controls[kept], naive.result()["controls"][0, : len(plan.kinds)][kept], atol=3e-4)
    check_choice(plan, naive.result())


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_stage_2_of_the_same_controls(device: str, preset: str):
    config, case = config_of(preset), random_case(6, nearest=1.2, count=300)
    planner = Planner(config, device=device)
    naive = NaivePlanner(planner)
    plan = case.plan(planner)
    naive.run()
    naive.arrays.controls[0, : len(plan.kinds)].assign(plan.controls)
    naive.run(first="stage2")
    result = naive.result()
    assert plan.status == PlanStatus.OK and (plan.collision_cost > 0.0).any()
    assert plan.best == result["best"][0]
    np.testing.assert_allclose(plan.goal_cost, result["J_goal"][0, : len(plan.kinds)], rtol=1e-5)
    np.testing.assert_allclose(plan.collision_cost, result["J_col"][0, : len(plan.kinds)], **COST)
    np.testing.assert_allclose(plan.stage2_cost, result["S2"][0, : len(plan.kinds)], **COST)
