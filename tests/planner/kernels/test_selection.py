import numpy as np
import pytest

from aero_planner import Plan, Planner, PlanStatus
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, random_case


def nearest_approach(plan: Plan, *, between: bool) -> float:
    """Return the minimum distance of the best instance's states, and of their midpoints, to the cloud [m]."""
    x = plan.positions[plan.best].astype(np.float64)
    places = np.concatenate((x[1:], 0.5 * (x[1:] + x[:-1]))) if between else x[1:]
    return float(reference.clearance(places, kept_points(plan), 10.0).min())


def cluttered(seed: int) -> Case:
    """Return a fast drone among thin posts, which fit between two states."""
    case, rng = random_case(seed, count=0, speed=7.0), np.random.default_rng(seed)
    foot = rng.uniform(-8, 8, (60, 2))
    foot = foot[np.linalg.norm(foot, axis=1) > 1.2]
    points = np.array([(*xy, z) for xy in foot for z in np.arange(-4, 4, 0.1)])
    case.points = (points + case.position).astype(np.float32)
    return case


@pytest.mark.parametrize("between", [True, False])
def test_safety_is_checked_between_the_states(device: str, between: bool):
    """Without `between_steps` some selected plans pass a post between two states, with it none does."""
    changes = {"candidates.prove_stop": "off", "candidates.speed_margin": 0.0, "costs.distance_min": 0.28}
    changes |= {"partition.continue_below": 0.0, "partition.continue_above": 0.0, "costs.waypoint_distance": 3.0}
    config = config_of(candidates__between_steps=between).replace(changes)
    planner, slipped, chosen = Planner(config, device=device), 0, 0
    for seed in range(60):
        plan = cluttered(seed).plan(planner)
        planner.reset()
        if plan.status == PlanStatus.OK:
            chosen += 1
            # Distances of positions 30 m from the origin are known to 1e-5 m.
            assert nearest_approach(plan, between=False) > 0.3 - 1e-5
            slipped += nearest_approach(plan, between=True) < 0.3 - 1e-5
    assert chosen > 10
    assert slipped == 0 if between else slipped > 0


def test_the_braking_candidate_with_the_largest_clearance_is_flown(device: str):
    """Next to a wall, braking turns away from it and ends as slow; without the fan it leads straight ahead."""
    case = random_case(0, count=0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.array([6.0, 0, 0]), np.zeros(3), case.beside(20, 0, 0)
    y, z = np.meshgrid(np.arange(-0.3, 6, 0.05), np.arange(-6, 6, 0.05))
    wall = np.stack((np.full_like(y, 2.4), y, z), axis=-1).reshape(-1, 3)
    case.points = (wall + case.position).astype(np.float32)
    ends, approaches = [], []
    for fan in (0.0, 20.0):
        # Too wide a berth for any candidate, so that it brakes.
        config = config_of(candidates__brake_fan=fan, candidates__safe_clearance=1.5, costs__distance_max=0.55)
        plan = case.plan(Planner(config, device=device))
        assert plan.status == PlanStatus.NO_SAFE_CANDIDATE and plan.kinds[plan.best] == "brake"
        assert np.linalg.norm(plan.velocities[plan.best, -1]) < 2.0
        ends.append(plan.positions[plan.best, -1] - case.position)
        approaches.append(nearest_approach(plan, between=True))
    assert abs(ends[0][1]) < 0.05
    assert ends[1][1] < -0.2, ends
    assert approaches[1] > approaches[0] + 0.01
