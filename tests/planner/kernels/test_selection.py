# Postponed annotations are left out: kernels made for a tuning refer to local types.

import functools
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Plan, Planner, PlanStatus, Sweeps, VehicleState
from aero_planner.kernels.best_instance import select_best
from aero_planner.device.kernel_tuning import CPU, CUDA, KernelTuning
from aero_planner.device.params import Params
from aero_planner.kernels.stops import STOPS
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, random_case
from tests.planner.pillars import GOAL, sweeps_of


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
    changes |= {"partition.continue_below": 0.0, "partition.continue_above": 0.0}
    changes |= {"costs.waypoint_distance": 3.0, "sampling.dt": 0.05}
    changes |= {"costs.soft_weight": 100.0, "costs.q_speed": 10.0}  # higher ones keep all plans away from the posts
    changes |= {"partition.fine_cells": 7, "costs.q_track": 5.0, "sampling.variance_thrust": 1.0}
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
        config = config_of(
            candidates__brake_fan=fan, candidates__safe_clearance=1.5, costs__distance_max=0.55, sampling__dt=0.05,
            candidates__prove_stop="off", candidates__brake_reach=0.35,
        )  # fmt: skip
        plan = case.plan(Planner(config, device=device))
        assert plan.status == PlanStatus.NO_SAFE_CANDIDATE and plan.kinds[plan.best] == "brake"
        assert np.linalg.norm(plan.velocities[plan.best, -1]) < 2.0
        ends.append(plan.positions[plan.best, -1] - case.position)
        approaches.append(nearest_approach(plan, between=True))
    assert abs(ends[0][1]) < 0.05
    assert ends[1][1] < -0.2, ends
    assert approaches[1] > approaches[0] + 0.01


def closing_in(planner: Planner, *, period: float = 0.02, count: int = 6) -> tuple[list[Plan], list[np.ndarray]]:
    """Return plans of a drone on which pillars on all sides close in after the first plan, and the flown positions."""
    axes = [4.0 * np.array([np.cos(angle), np.sin(angle)]) for angle in np.arange(20) * np.pi / 10]
    sweeps, _ = sweeps_of([(axis, -0.4 * axis) for axis in axes], np.zeros(3))
    arrival = sweeps.arrivals[-1]
    assert arrival is not None
    position, velocity, attitude = np.zeros(3), np.array([3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    config = planner.config.replace({"sampling.dt": period})
    cloud, plans, flown = Sweeps([np.full((1, 3), 60.0, np.float32)]), [], [position]
    for k in range(count):
        state = VehicleState(position, velocity, attitude, time=arrival.time + period * k)
        plans.append(planner.plan(state, GOAL, cloud))
        x = reference.roll_out(position, attitude, velocity, plans[-1].command[:1].astype(np.float64), config)
        position, velocity, attitude, cloud = x.p[-1], x.v[-1], x.q[-1], sweeps
        flown.append(position)
    return plans, flown


def test_a_proven_stop_that_is_clear_of_what_stands_is_flown_whatever_moves(device: str):
    planner = Planner(config_of(partition__predict_speed=0.5, sampling__dt=0.05), device=device)
    plans, _ = closing_in(planner)
    assert plans[0].status == PlanStatus.OK
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    assert plans[-1].moving is not None and len(plans[-1].moving.positions) == 20
    assert planner.history().stop_age[0] == pytest.approx(0.1)


@pytest.mark.parametrize(("period", "count"), [(0.02, 10), (0.049, 5), (0.05, 4)])
def test_a_proven_stop_is_flown_as_it_was_proven(device: str, period: float, count: int):
    """However often the planner plans meanwhile, the drone is where the stop leads; its time step is 0.05 s."""
    planner = Planner(config_of(partition__predict_speed=0.5, sampling__dt=0.05), device=device)
    plans, flown = closing_in(planner, period=period, count=count)
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    fine = planner.config.replace({"sampling.dt": 0.005})
    stop = np.repeat(planner.history().stop[0].astype(np.float64), 10, axis=0)[: round(200 * period * count)]
    expected = reference.roll_out(flown[0], np.array([1.0, 0, 0, 0]), np.array([3.0, 0, 0]), stop, fine)
    np.testing.assert_allclose(flown[-1], expected.p[-1], atol=2e-3)
    for plan in plans:
        np.testing.assert_array_equal(plan.command, plan.controls[plan.best])


@functools.cache
def select_kernel(tuning: KernelTuning) -> Any:
    select = select_best(tuning)

    @wp.kernel(module="unique")
    def select_kernel(
        instances: int,
        params: wp.array(dtype=Params),
        instance_scores: wp.array2d(dtype=wp.vec3),
        stop_clearance: wp.array2d(dtype=float),
        choice: wp.array2d(dtype=int),
    ):
        lane = wp.tid()
        best, flown, replaced, status, stop = select(
            0, lane, instances, 0, 1.0, 0.0, params[0], 1, instance_scores, stop_clearance
        )
        choice[lane, 0] = best
        choice[lane, 1] = flown
        choice[lane, 2] = replaced
        choice[lane, 3] = status
        choice[lane, 4] = stop

    return select_kernel


def select(planner: Planner, scores: list[tuple[float, float, float]], stops: np.ndarray) -> list[int]:
    """Return instance, row, replaced instance, status and stop that `select_best` returns; `stops` is [M, STOPS]."""
    tuning = CUDA if wp.get_device(planner.device).is_cuda else CPU
    lanes = tuning.threads_per_instance
    choices = wp.empty((lanes, 5), dtype=int, device=planner.device)
    arrays = [
        wp.array([scores], dtype=wp.vec3, device=planner.device),
        wp.array(stops.reshape(1, -1), dtype=float, device=planner.device),
    ]
    inputs = [len(stops), planner.params, *arrays]
    wp.launch(select_kernel(tuning), lanes, inputs=inputs, outputs=[choices], device=planner.device, block_dim=32)
    first, *others = choices.numpy().tolist()
    assert all(choice == first for choice in others)
    return first


@pytest.mark.parametrize(
    ("braking", "flown"),
    [
        ([(0.4, 0.4), (0.5, 0.5), (0.35, 0.35)], 6),  # the proven stop comes first
        ([(0.4, 0.4), (0.5, 0.5), (0.2, 0.2)], 2),  # the largest clearance
        ([(0.4, 0.4), (0.1, 0.5), (0.0, 0.35)], 1),  # it evades what moves, while the proven stop does not
        ([(0.2, 0.5), (0.1, 0.5), (0.0, 0.35)], 6),  # nothing evades what moves
        ([(0.25, 0.25), (0.1, 0.5), (0.0, 0.2)], 2),  # what stands counts more
        ([(0.25, 0.25), (0.1, 0.2), (0.0, 0.2)], 1),
    ],
)
def test_braking_candidates_are_chosen_by_what_stands_first(
    device: str, braking: list[tuple[float, float]], flown: int
):
    """`braking` are the clearances of two braking guides and the proven stop, with and without what moves."""
    planner = Planner(config_of(), device=device)
    *guides, proven = [(0.0, *clearances) for clearances in braking]
    rows = [(0.0, -1.0, -1.0), *guides, *[(0.0, -2.0, -2.0)] * 3, proven]
    assert select(planner, rows, np.full((1, int(STOPS)), -1.0))[1] == flown


@pytest.mark.parametrize(
    ("braking", "widest", "is_flown"),
    [
        (0.20, 0.25, True),
        (0.26, 0.25, False),  # braking keeps a larger clearance
        (0.30, 0.25, False),  # braking is clear
        (0.05, 0.13, False),  # contact is certain, and braking makes it slow
    ],
)
@pytest.mark.parametrize("proof", ["instead", "required"])
def test_where_no_braking_is_clear_the_instance_with_the_widest_stop_is_flown(
    device: str, braking: float, widest: float, is_flown: bool, proof: str
):
    planner = Planner(config_of(candidates__prove_stop=proof), device=device)
    rows = [(5.0, 0.2, 0.2), (1.0, 0.1, 0.1), (9.0, 0.0, 0.0), *[(0.0, braking, braking)] * 6]
    stops = np.full((3, int(STOPS)), 0.01)
    stops[1, 0], stops[2, 4] = 0.12, widest
    chosen = select(planner, rows, stops)
    if is_flown and proof == "instead":
        assert chosen == [2, 2, -1, PlanStatus.NO_SAFE_CANDIDATE, 4]
    else:
        assert chosen[0] == chosen[2] == 0 and chosen[1] >= 3  # a braking candidate replaces instance 0
