"""Stage II: which instance is selected, and what replaces it."""

# Postponed annotations are left out: the kernel below refers to local types.

from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Plan, Planner, PlanStatus
from aero_planner.device.params import Params
from aero_planner.device.records import Scores, bundle
from aero_planner.kernels.selection import dynamic_allowance
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, random_case


@pytest.mark.parametrize("seed", range(6))
def test_best_has_the_lowest_S2_among_the_safe_instances(device: str, seed: int):
    config = config_of(stages__active="", candidates__speed_margin=0.0)
    plan = random_case(seed, nearest=0.5, count=1500).plan(Planner(config, device=device))
    safe = np.flatnonzero(plan.clearance.min(axis=1) >= np.float32(config.candidates.safe_clearance))
    if plan.status == PlanStatus.OK:
        assert plan.best == safe[np.argmin(plan.stage2_cost[safe])]
    else:
        assert all(m == plan.best for m in safe)


@pytest.mark.parametrize("seed", range(6))
def test_best_of_the_paper_has_the_lowest_S2_of_all(device: str, seed: int):
    case = random_case(seed, nearest=0.5, count=1500)
    plan = case.plan(Planner(config_of("paper"), device=device))
    if plan.status == PlanStatus.OK:
        assert plan.best == np.argmin(plan.stage2_cost)


@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_a_fast_drone_keeps_a_margin(device: str, margin: float):
    """Its clearances count less by the margin times its speed."""
    config, chosen, near = config_of(stages__active="", candidates__speed_margin=margin), 0, 0
    planner = Planner(config, device=device)
    for seed in range(40):
        planner.reset()
        plan = random_case(seed, nearest=0.8, count=800, speed=7.0).plan(planner)
        if plan.status == PlanStatus.OK:
            speed = np.linalg.norm(plan.velocities[plan.best, 1:], axis=1)
            kept = plan.clearance[plan.best] - margin * speed
            # The clearances of a plan end at d_max, the planner's own do not.
            counted = plan.clearance[plan.best] < config.costs.distance_max
            assert (kept[counted] >= config.candidates.safe_clearance - 1e-5).all()
            chosen += 1
            near += bool((plan.clearance[plan.best] - 0.02 * speed < config.candidates.safe_clearance)[counted].any())
    assert chosen > 5 and (near > 0) == (margin == 0.0)


@pytest.mark.parametrize("speed", [12.0, 24.0])
def test_a_drone_that_is_faster_than_its_limit_is_clear_in_open_space_and_sees_as_far_as_it_needs(
    device: str, speed: float
):
    """Its limit was lowered in flight; distances end where a drone of its speed no longer needs them."""
    config = config_of("racer", vehicle__speed_limit=1.0)
    case = random_case(0, count=0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.array([speed, 0, 0]), np.zeros(3), case.beside(90, 0, 0)
    plan = case.plan(Planner(config, device=device, seed=1))
    assert plan.status == PlanStatus.OK
    farthest = max(config.partition.range_max, 2.0 * config.anchors.lookahead_time * speed)
    np.testing.assert_allclose(plan.fine_range, farthest, rtol=1e-6)


def next_to_a_wall() -> Case:
    """Return a fast drone with a wall across its way, which is nearer on its left."""
    case = random_case(0, count=0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.array([6.0, 0, 0]), np.zeros(3), case.beside(20, 0, 0)
    y, z = np.meshgrid(np.arange(-6, 6, 0.05), np.arange(-6, 6, 0.05))
    wall = np.stack((3.1 - y, y, z), axis=-1).reshape(-1, 3)
    case.points = (wall + case.position).astype(np.float32)
    return case


def test_the_braking_candidate_with_the_largest_clearance_is_flown(device: str):
    """Next to a wall, braking turns away from it, and ends as slow as straight ahead."""
    # Too wide a berth for any candidate, so that it brakes.
    config = config_of(candidates__safe_clearance=1.5, costs__distance_max=3.0, stages__active="")
    case, planner = next_to_a_wall(), Planner(config, device=device)
    plan: Plan = case.plan(planner)
    assert plan.status == PlanStatus.NO_SAFE_CANDIDATE and plan.kinds[plan.best] == "brake"
    assert plan.braking is not None
    margin = config.candidates.speed_margin * np.linalg.norm(plan.braking.velocities[:, 1:], axis=-1)
    nearest = []
    for k, positions in enumerate(plan.braking.positions[:, 1:].astype(np.float64)):
        nearest.append((reference.clearance(positions, kept_points(plan), 3.0) - margin[k]).min())
    flown = int(np.argmax(nearest))
    np.testing.assert_array_equal(plan.positions[plan.best], plan.braking.positions[flown])
    assert flown > 0 and nearest[flown] > nearest[0] + 0.01
    assert np.linalg.norm(plan.velocities[plan.best, -1]) < 2.0
    assert plan.positions[plan.best, -1, 1] - case.position[1] < -0.2
    assert abs(plan.braking.positions[0, -1, 1] - case.position[1]) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_replaced_instance_shows_what_replaces_it(device: str, seed: int):
    case, planner = random_case(seed, speed=5.0), Planner(config_of(), device=device)
    plan = case.plan(planner, cloud_age=9.0)
    o, m = planner.outputs, int(plan.best)
    row = int(o.flown.numpy()[0])
    assert plan.status == PlanStatus.STALE_CLOUD and plan.kinds[m] == "brake"
    assert len(planner.config.kinds) <= row < len(planner.config.kinds) + 5
    for name in ("anchors", "guides", "controls", "positions", "velocities", "quaternions"):
        np.testing.assert_array_equal(getattr(plan, name)[m], getattr(o, name).numpy()[0, row], err_msg=name)
    for name in ("stage2_cost", "goal_cost", "collision_cost"):
        assert getattr(plan, name)[m] == getattr(o, name).numpy()[0, row]


AllScores: Any = Scores


@wp.kernel
def allowance_kernel(scores: AllScores, params: wp.array(dtype=Params), out: wp.array(dtype=float)):
    m = wp.tid()
    out[m] = dynamic_allowance(0, m, scores, params[0])  # pyright: ignore[reportArgumentType]


def test_dynamic_obstacles_near_the_start_may_come_nearer_but_static_ones_may_not(device: str):
    """The starts are clearances from all and from static obstacles: nothing near, a dynamic one, a static one, both."""
    planner = Planner(config_of(candidates__safe_clearance=0.35), device=device)
    starts = np.array([(1.0, 1.0), (0.1, 1.0), (0.1, 0.1), (0.1, 0.32)])
    # Of two states, the last one is the start.
    both = (np.stack((np.full(4, 5.0), start), axis=1)[None] for start in starts.T)
    everything, static = (wp.array(clearance, dtype=float, device=device) for clearance in both)
    out = wp.zeros(4, dtype=float, device=device)
    scores = bundle(Scores, state_clearance=everything, static_clearance=static)
    wp.launch(allowance_kernel, 4, inputs=[scores, planner.params, out], device=device)
    np.testing.assert_allclose(out.numpy(), [0.0, 0.35 - 0.08, 0.0, 0.3 - 0.08], atol=1e-6)
