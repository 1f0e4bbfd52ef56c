"""The planner's judgement of its instances."""

import numpy as np
import pytest

from aero_planner import Goal, Planner, PlannerConfig, PlanStatus, VehicleState

GOAL = Goal(np.array([20.0, 0.0, 2.0]))


def state_at(speed: float) -> VehicleState:
    return VehicleState(np.array([0.0, 0.0, 2.0]), np.array([speed, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))


def wall(distance: float) -> np.ndarray:
    """Return a wall across the way with a hole to the left."""
    y, z = np.meshgrid(np.arange(-3.0, 1.5, 0.05), np.arange(0.0, 5.0, 0.05))
    return np.stack((np.full(y.size, distance), y.ravel(), z.ravel()), axis=1).astype(np.float32)


@pytest.mark.parametrize("changes", [
    {}, {"stop_proof.prove_stop": False}, {"stages.active": ""}, {"candidates.safe_clearance": 1.0},
])  # fmt: skip
@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_the_cheapest_admissible_instance_is_chosen(device, changes, distance):
    planner = Planner(PlannerConfig().replace({"sampling.samples": 32} | changes), device=device)
    planner.plan(state_at(4.0), GOAL, wall(distance))
    plan = planner.plan(state_at(4.0), GOAL, wall(distance))
    safety, best, M = planner.safety(), int(plan.best), len(plan.kinds)
    least = planner.workspace.least_clearance.numpy()[0, :M, 0]
    np.testing.assert_allclose(safety.clearance.min(axis=1), least, atol=1e-6)
    np.testing.assert_array_equal(safety.keeps_clearance, least >= np.float32(safety.demanded_clearance))
    assert safety.demanded_clearance <= planner.config.candidates.safe_clearance + 1e-6
    refused = safety.refused_by.get("stop_proof", np.zeros(M, np.bool_))
    if planner.config.stop_proof.prove_stop and safety.refused_by:
        np.testing.assert_array_equal(safety.is_admissible, ~refused)
    else:
        assert not refused.any()
        np.testing.assert_array_equal(safety.is_admissible, safety.keeps_clearance)
    if plan.status == PlanStatus.OK:
        assert safety.replaced is None and safety.is_safe[best]
        assert best == np.where(safety.is_admissible, plan.stage2_cost, np.inf).argmin()
    else:
        assert safety.replaced == best and not safety.is_admissible.any() and not safety.is_safe.any()


def test_an_instance_that_a_stop_replaces_is_not_safe(device):
    planner = Planner(PlannerConfig().replace({"sampling.samples": 32}), device=device)
    plan = planner.plan(state_at(0.0), GOAL, wall(8.0), cloud_age=10.0)
    safety = planner.safety()
    assert plan.status == PlanStatus.STALE_CLOUD and safety.replaced == plan.best
    assert safety.is_admissible[plan.best] and not safety.is_safe[plan.best]
    costs = planner.cost_terms([int(plan.best)])
    np.testing.assert_allclose(costs.of_stage2().values.sum(axis=(1, 2)), plan.stage2_cost[plan.best], rtol=1e-5)
