"""Compare the planner with the paper's preset with the reference of the paper, stage by stage and as a whole."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, VehicleState
from aero_planner.forest_cloud import forest_cloud
from aero_planner.reference import ReferencePlanner
from aero_planner.reference.costs import clearance
from aero_planner.reference.parameters import PATHS
from aero_planner.sampled_noise import noise_of_next_plan
from tests.planner.cases import Case, batch_of, config_of, exact, kept_points, random_case, random_quaternion

# Both sides sum some 200 float32 terms per rollout, over states that agree to 1e-5 m.
COST: dict[str, Any] = {"rtol": 5e-5, "atol": 1e-2}
EDGE = 3e-5
"""Distance to a step of the penalty within which rounding may put a state on its other side [m]."""


@dataclass
class Both:
    """The same plan of both."""

    config: PlannerConfig
    planner: Planner
    plan: Plan
    reference: ReferencePlanner
    expected: Plan


def both(device: str, case: Case, *, goal: Goal | None = None, **changes: Any) -> Both:
    """Return the plans of both in a case."""
    config, goal = config_of("paper", **changes), goal or Goal(case.goal)
    planner, reference = Planner(config, device=device, seed=7), ReferencePlanner(config, device=device)
    expected = reference.plan(case.state, goal, case.points, noise_of_next_plan(planner)[0])
    return Both(config, planner, planner.plan(case.state, goal, case.points), reference, expected)


def planned(plan: Plan) -> NDArray[np.bool_]:
    """Return the instances that no braking candidate has replaced, as a mask [M]."""
    return np.array(plan.kinds) == "anchor"


def away_from_steps(reference: ReferencePlanner, config: PlannerConfig) -> NDArray[np.bool_]:
    """Return the samples [M, K] without a state that rounding may move across a step of the penalty, as a mask."""
    d = reference.arrays.sample_clearance.numpy()
    edges = config.costs.distance_min, config.costs.distance_max
    return np.logical_not(np.any([np.abs(d - edge) < EDGE for edge in edges], axis=0).any(axis=-1))


def check_partition(plan: Plan, expected: Plan) -> None:
    np.testing.assert_array_equal(plan.fine_range, expected.fine_range)
    kept, points = kept_points(plan), kept_points(expected)
    np.testing.assert_array_equal(kept, points)
    assert plan.dropped_points == expected.dropped_points
    np.testing.assert_array_equal(plan.safe_range, expected.safe_range)
    np.testing.assert_allclose(plan.safe_direction, expected.safe_direction, atol=1e-6)


def check_guides(plan: Plan, planner: Planner, expected: Plan, reference: ReferencePlanner) -> None:
    kept = planned(plan)
    np.testing.assert_allclose(plan.initial_endpoints[kept], expected.initial_endpoints[kept], atol=1e-5)
    np.testing.assert_allclose(plan.anchors[kept], expected.anchors[kept], atol=1e-5)
    np.testing.assert_allclose(plan.guide_coefficients[kept], expected.guide_coefficients[kept], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(plan.guides[kept], expected.guides[kept], atol=3e-5)
    nominal = planner.workspace.nominal_controls.numpy()[0, : len(kept)]
    np.testing.assert_allclose(nominal, reference.arrays.nominal_controls.numpy(), atol=1e-3)


def check_choice(plan: Plan, expected: Plan) -> None:
    """The lowest S2 is chosen; if it comes too near to a point, braking replaces it."""
    assert plan.best == expected.best
    assert (plan.kinds[plan.best] == "anchor") == (plan.status == PlanStatus.OK)
    if plan.status == PlanStatus.OK:
        np.testing.assert_allclose(plan.command, expected.command, atol=2e-3)
        for name in ("positions", "velocities", "quaternions"):
            np.testing.assert_allclose(getattr(plan, name)[plan.best], getattr(expected, name)[plan.best], atol=5e-4)


def check(result: Both) -> None:
    """Compare everything that does not depend on which of two nearly equal samples has the lower cost."""
    plan, expected = result.plan, result.expected
    check_partition(plan, expected)
    check_guides(plan, result.planner, expected, result.reference)
    comparable = away_from_steps(result.reference, result.config)
    assert comparable.mean() > 0.8
    np.testing.assert_allclose(plan.stage1_cost[comparable], expected.stage1_cost[comparable], **COST)
    check_choice(plan, expected)


@pytest.mark.parametrize("seed", range(6))
def test_clutter(device: str, seed: int):
    nearest, speed = (0.3, 0.6, 1.0, 1.5, 0.8, 2.0)[seed], (4.0, 9.0)[seed % 2]
    check(both(device, random_case(seed, count=1000 * (seed + 1), nearest=nearest, speed=speed)))


@pytest.mark.parametrize("speed", [0.0, 1.0, 4.0, 8.0])
def test_forest(device: str, speed: float):
    case = random_case(1, tilt=0.3)
    case.position, case.goal = np.array([0.0, 0.0, 2.0]), np.array([30.0, 0.0, 2.0])
    case.velocity, case.points = exact([speed, 0.1 * speed, 0.0]), forest_cloud(20_000, seed=3)
    result = both(device, case)
    check(result)
    assert result.plan.dropped_points > 1000


@pytest.mark.parametrize("distance", [0.7, 1.5, 4.0])
def test_wall_in_front(device: str, distance: float):
    case = random_case(2, speed=3.0)
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-4.0, 4.0, 0.1), np.arange(-2.0, 2.0, 0.1)))
    case.points = (case.position + np.stack((np.full_like(y, distance), y, z), axis=1)).astype(np.float32)
    case.goal = case.beside(15.0, 1.0, 0.5)
    check(both(device, case))


@pytest.mark.parametrize("seed", range(2))
def test_empty_cloud(device: str, seed: int):
    """All ranges tie, so that every anchor goes to the fine cell that is nearest to its initial direction."""
    result = both(device, random_case(seed, count=0))
    check(result)
    assert len(kept_points(result.plan)) == 0 and (result.plan.fine_range == 10.0).all()


@pytest.mark.parametrize("seed", range(4))
def test_tilted_and_overturned_attitudes(device: str, seed: int):
    check(both(device, random_case(seed + 20, nearest=0.8, tilt=np.pi)))


def test_state_and_goal_with_everything_given(device: str):
    """An attitude that is not normalised, no acceleration, and a velocity and an attitude at the goal within reach."""
    case = random_case(9, nearest=1.5)
    case.quaternion = 3.0 * case.quaternion
    case.goal = case.beside(1.0, 3.0, 0.5)
    config = config_of("paper")
    planner, reference = Planner(config, device=device), ReferencePlanner(config, device=device)
    state = VehicleState(case.position, case.velocity, case.quaternion)
    goal = Goal(case.goal, velocity=(1.0, 2.0, -0.5), quaternion=2.0 * random_quaternion(np.random.default_rng(4)))
    expected = reference.plan(state, goal, case.points, noise_of_next_plan(planner)[0])
    check(Both(config, planner, planner.plan(state, goal, case.points), reference, expected))


def test_points_that_are_far_or_not_finite(device: str):
    rng, case = np.random.default_rng(3), random_case(3)
    bad = np.full((60, 3), np.nan, np.float32)
    bad[20:40] = case.points[:20]
    bad[np.arange(20, 40), rng.integers(3, size=20)] = rng.choice([np.inf, -np.inf, np.nan], 20)
    bad[40:] = rng.choice([-1.0, 1.0], (20, 3)) * np.logspace(2, 38, 20)[:, None]
    case.points = rng.permutation(np.concatenate((case.points, bad)))
    result = both(device, case)
    check(result)
    assert result.plan.dropped_points == 40


@pytest.mark.parametrize("seed", range(3))
def test_rollouts_that_leave_the_range(device: str, seed: int):
    """Some positions beyond r_max are within d_max of a point at the rim."""
    case = random_case(seed + 30, count=4000, nearest=0.8, speed=8.0)
    result = both(device, case, partition__range_max=2.0, costs__distance_max=0.9)
    check(result)
    outside = np.linalg.norm(result.plan.positions - case.position, axis=2)[:, 1:] > 2.05
    assert (outside & (result.plan.clearance < 0.9)).any()


@pytest.mark.parametrize("seed", range(6))
def test_other_values_of_every_parameter(device: str, seed: int):
    """A parameter that only one of them reads, or reads as another one, shows."""
    rng = np.random.default_rng(seed)
    names = [path.replace(".", "__") for path in PATHS.values() if path != "anchors.lookahead"]
    values = {name: float(config_of("paper").get(name.replace("__", "."))) for name in names}
    changes: dict[str, Any] = {name: value * rng.uniform(0.8, 1.25) for name, value in values.items()}
    sizes = {"anchors__columns": 4, "anchors__rows": 2, "partition__fine_cells": 5, "sampling__steps": 17}
    changes |= sizes | {"anchors__lookahead": rng.uniform(2.0, 5.0)}
    check(both(device, random_case(seed + 40, nearest=1.0), **changes))


@pytest.mark.parametrize("samples", [1, 33, 100])
def test_samples_that_fill_no_vector(device: str, samples: int):
    check(both(device, random_case(12, nearest=0.8), sampling__samples=samples, sampling__steps=11))


def test_many_points(device: str):
    """There are so many points that most lie close to a border of their cell."""
    result = both(device, random_case(5, count=200_000))
    check_partition(result.plan, result.expected)
    assert len(kept_points(result.plan)) > 5000


@pytest.mark.parametrize("ahead", [0.0, 2.0])
def test_goal_within_the_look_ahead(device: str, ahead: float):
    case = random_case(8, count=500, nearest=1.5)
    case.goal = case.beside(ahead, 0.25, 0.0)
    check(both(device, case))


def test_goal_at_the_drone(device: str):
    case = random_case(13, count=500, nearest=1.5)
    case.goal = case.position
    check(both(device, case))


def test_the_paper_has_no_history(device: str):
    """The second plan of the planner does not depend on the first one."""
    result = both(device, random_case(14))
    other = random_case(15)
    expected = result.reference.plan(other.state, Goal(other.goal), other.points, noise_of_next_plan(result.planner)[0])
    check(Both(result.config, result.planner, other.plan(result.planner), result.reference, expected))


@pytest.mark.parametrize(("seed", "is_safe"), [(0, True), (9, True), (5, False), (6, False)])
def test_a_candidate_is_flown_if_it_keeps_its_clearance(device: str, seed: int, is_safe: bool):
    """The paper flies the lowest S2 in any case; the planner brakes instead where that one is not safe."""
    result = both(device, random_case(seed, count=3000, nearest=1.0, speed=3.0))
    check(result)
    nearest = result.expected.clearance[result.expected.best].min()
    assert (nearest >= result.config.candidates.safe_clearance) == is_safe
    assert (result.plan.status == PlanStatus.OK) == is_safe


def test_batch(device: str):
    """Each drone plans as the reference with its noise does."""
    config, cases = config_of("paper"), [random_case(seed, count=500, nearest=1.2) for seed in range(3)]
    planner, reference = Planner(config, device=device, seed=3, batch=3), ReferencePlanner(config, device=device)
    noise = noise_of_next_plan(planner)
    plan = planner.plan(*batch_of(cases))
    for b, case in enumerate(cases):
        expected = reference.plan(case.state, Goal(case.goal), case.points, noise[b])
        np.testing.assert_array_equal(plan.fine_range[b], expected.fine_range)
        np.testing.assert_array_equal(plan.filtered_points[b], expected.filtered_points)
        same = away_from_steps(reference, config)
        np.testing.assert_allclose(plan.stage1_cost[b][same], expected.stage1_cost[same], **COST)
        assert np.asarray(plan.best)[b] == expected.best


@pytest.mark.parametrize("seed", range(3))
def test_clearance_at_the_same_positions(device: str, seed: int):
    """The same positions have the same clearance, up to the rounding of the squared distance."""
    result = both(device, random_case(seed, count=1500, nearest=0.3))
    a = result.reference.arrays
    states: Any = a.states.numpy().copy()
    states["p"][:, 0] = result.plan.positions
    a.states.assign(states)
    wp.launch(clearance, dim=a.clearance.shape, inputs=[a.filtered_points, a.states, a.clearance], device=device)
    np.testing.assert_allclose(result.plan.clearance, result.reference.result().clearance, rtol=3e-7)
    assert (result.plan.clearance < result.config.costs.distance_max).sum() > 20


@pytest.mark.parametrize("seed", range(3))
def test_update_and_stage_2_from_the_same_costs(device: str, seed: int):
    """The softmin turns a rounding error of a large cost into another weight, so both use the planner's costs."""
    result = both(device, random_case(seed, nearest=1.0, count=400), sampling__samples=64)
    result.reference.arrays.stage1_cost.assign(result.plan.stage1_cost)
    result.reference.launch("update")
    result.reference.launch("stage2")
    kept, expected = planned(result.plan), result.reference.result()
    np.testing.assert_allclose(result.plan.controls[kept], expected.controls[kept], atol=3e-4)
    check_choice(result.plan, expected)


def test_stage_2_of_the_same_controls(device: str):
    result = both(device, random_case(6, nearest=1.2, count=300))
    plan = result.plan
    assert plan.status == PlanStatus.OK and (plan.collision_cost > 0.0).any()
    result.reference.arrays.controls.assign(plan.controls[:, None])
    result.reference.launch("stage2")
    expected = result.reference.result()
    assert plan.best == expected.best
    for name in ("positions", "velocities", "quaternions"):
        np.testing.assert_allclose(getattr(plan, name), getattr(expected, name), atol=1e-5)
    np.testing.assert_allclose(plan.goal_cost, expected.goal_cost, rtol=1e-5)
    np.testing.assert_allclose(plan.collision_cost, expected.collision_cost, **COST)
    np.testing.assert_allclose(plan.stage2_cost, expected.stage2_cost, **COST)


def test_options_and_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"the paper has no costs\.q_speed: .* sampling\.temperature"):
        ReferencePlanner(config_of("paper", costs__q_speed=1.0))
    case, reference = random_case(0), ReferencePlanner(config_of("paper"))
    noise = np.zeros((15, 16, 25, 4))
    with pytest.raises(ValueError, match=r"noise has shape \(15, 16, 25, 3\); it must have shape \(15, 16, 25, 4\)"):
        reference.plan(case.state, Goal(case.goal), case.points, noise[..., :3])
    with pytest.raises(ValueError, match=r"points has shape \(3,\); it must have shape \(P, 3\)"):
        reference.plan(case.state, Goal(case.goal), case.points[0], noise)
    with pytest.raises(ValueError, match=r"goal\.position is .* every value must be finite"):
        reference.plan(case.state, Goal((np.nan, 0.0, 0.0)), case.points, noise)
