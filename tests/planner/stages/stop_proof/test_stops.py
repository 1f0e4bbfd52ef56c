"""Backup stops: how they are flown, which are clear, and what is flown where no candidate has one."""

# Postponed annotations are left out: the kernel below refers to local types.

import functools
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, Sweeps, VehicleState
from aero_planner.composition import Composition
from aero_planner.device.params import Params
from aero_planner.device.records import Scores, bundle
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.selection import fallback
from aero_planner.stages.stop_proof.stops import STOPS, StopProof
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, level_case, random_case, shell
from tests.planner.pillars import GOAL, sweeps_of
from tests.planner.reference import Array

LAGS: dict[str, Any] = {"vehicle.thrust_lag": 0.05, "vehicle.rate_lag": 0.07}


def test_the_stop_that_was_proven_is_flown_when_no_candidate_has_one(device: str):
    case, planner = level_case(speed=5.0), Planner(config_of(), device=device)

    def plan(time: float):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal(case.goal), case.points)

    first = plan(0.0)
    stop = planner.history().arrays["proven_stop"][0].astype(np.float64)
    assert first.status == PlanStatus.OK
    np.testing.assert_array_equal(stop[0], first.command[0])
    x = reference.roll_out(case.position, case.quaternion, case.velocity, stop, planner.config)
    assert np.linalg.norm(x.v[-1]) < 1.0
    case.points = shell(case.position, 0.7)  # no candidate is clear now
    second = plan(0.1)
    assert second.status == PlanStatus.NO_SAFE_CANDIDATE and second.kinds[second.best] == "brake"


def test_stops_are_rolled_out_with_the_lags_of_the_drone(device: str):
    case, planner = level_case(speed=5.0), Planner(config_of().replace(LAGS), device=device)
    plan, config = case.plan(planner), planner.config
    arrays, N = planner.arrays_of("stop_proof"), config.sampling.steps
    stop_controls, stop_positions = arrays["stop_controls"].numpy()[0], arrays["stop_positions"].numpy()[0]
    best = int(plan.best)
    for stop, switch in ((0, 1), (3, N // 4), (5, N)):
        row = best * int(STOPS) + stop
        controls = np.concatenate((plan.controls[best, :switch], stop_controls[row]))
        x = reference.roll_out(case.position, case.quaternion, case.velocity, controls, config)
        np.testing.assert_allclose(stop_positions[row, 1:], x.p[switch:], atol=2e-3)


def test_a_stop_is_forgotten_while_stops_are_not_proven(device: str):
    case, config = level_case(speed=5.0), config_of()
    planner = Planner(config, device=device)
    case.plan(planner)
    assert planner.history().arrays["proven_stop_age"][0] == 0.0
    planner.configure(config.replace({"stop_proof.prove_stop": False}))
    case.plan(planner)
    assert np.isinf(planner.history().arrays["proven_stop_age"][0])


def test_the_stop_that_was_proven_is_no_braking_candidate_of_a_plan(device: str):
    """It may take two horizons, so that it does not end at rest as the braking candidates do."""
    plan = level_case(speed=5.0).plan(Planner(config_of(), device=device))
    assert plan.braking is not None
    assert len(plan.braking.positions) == len(plan.braking.velocities) == len(plan.braking.clearance) == 5


def switch_steps(config: PlannerConfig) -> list[int]:
    """Return the time step at which each stop leaves its candidate, in the first plan."""
    N = config.sampling.steps
    first = int(np.ceil(config.sampling.replan_period / config.sampling.dt))
    return [max(first, step) for step in (0, 0, 0, N // 4, N // 2, N)]


def stop_clearances(case: Case, planner: Planner, plan: Plan) -> tuple[Array, Array]:
    """Return the clearance of each stop in the first plan, and whether it is far from any limit, both [M * STOPS]."""
    config, positions = planner.config, planner.arrays_of("stop_proof")["stop_positions"].numpy()[0].astype(np.float64)
    controls = planner.arrays_of("stop_proof")["stop_controls"].numpy()[0].astype(np.float64)
    margin, safe = config.candidates.speed_margin, config.candidates.safe_clearance
    R = reference.rotation(reference.unit(case.quaternion))
    clearances, is_sure = np.zeros(len(positions)), np.ones(len(positions), bool)
    for row in range(len(positions)):
        m, switch = row // int(STOPS), switch_steps(config)[row % int(STOPS)]
        speeds = np.linalg.norm(np.diff(positions[row], axis=0), axis=1) / config.sampling.dt
        x = np.concatenate((positions[row, 1:], plan.positions[m, 1 : switch + 1]))
        v = np.concatenate((speeds, np.linalg.norm(plan.velocities[m, 1 : switch + 1], axis=1)))
        offsets = x - case.position
        distance = np.linalg.norm(offsets, axis=1)
        i, j, border = reference.cell_indices(offsets @ R, *plan.fine_range.shape)
        is_occluded = (distance > 0.5) & (distance > plan.fine_range[i, j])
        is_sure[row] = ((border > 1e-3) & (np.abs(distance - plan.fine_range[i, j]) > 1e-3) | (distance < 0.49)).all()
        flown = np.concatenate((plan.controls[m, :switch], controls[row]))
        end = reference.roll_out(case.position, case.quaternion, case.velocity, flown, config).v[-1]
        is_sure[row] &= abs(np.linalg.norm(end) - 1.0) > 0.01
        clear = np.where(is_occluded, 0.0, reference.clearance(x, kept_points(plan), 10.0) - margin * v).min()
        clearances[row] = min(clear, safe) if np.linalg.norm(end) < 1.0 else 0.0
    return clearances, is_sure


def test_stops_are_clear_if_all_their_states_are_clear_and_seen(device: str):
    """One that is not clear need not be evaluated to its end. The best of the instances with a clear stop is flown."""
    config = config_of(anchors__columns=3, anchors__rows=2)
    planner, clear, unclear = Planner(config, device=device), 0, 0
    least = min(config.stop_proof.stop_clearance, config.candidates.safe_clearance)
    for seed in range(12):
        planner.reset()
        case = random_case(seed, nearest=0.8 + 0.05 * seed, count=600, tilt=0.3)
        plan = case.plan(planner)
        found = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0]
        has_stop = (found.reshape(-1, int(STOPS)) >= least).any(axis=1)
        if plan.status != PlanStatus.OK:  # a braking candidate has replaced what the stops belong to
            assert not has_stop.any()
            continue
        assert plan.best == np.argmin(np.where(has_stop, plan.stage2_cost, np.inf))
        expected, is_sure = stop_clearances(case, planner, plan)
        is_sure &= np.abs(expected - least) > 1e-4
        is_clear = expected >= least
        np.testing.assert_allclose(found[is_sure & is_clear], expected[is_sure & is_clear], atol=1e-4)
        assert (found[is_sure & ~is_clear] < least).all()
        clear, unclear = clear + np.sum(is_sure & is_clear), unclear + np.sum(is_sure & ~is_clear)
    assert clear > 20 and unclear > 20


def test_a_stop_behind_what_was_seen_is_not_clear(device: str):
    """Between two walls, a stop that leads past the edge of the first one is clear only without that wall."""
    planner, is_clear = Planner(config_of(unseen_space__continuation=0.0), device=device), []
    case = level_case(speed=4.0)
    y, z = np.meshgrid(np.arange(-3, 3, 0.04), np.arange(-3, 3, 0.04))
    screen = np.stack((np.full_like(y, 1.2), y, z), axis=-1).reshape(-1, 3)
    hole = screen[np.maximum(np.abs(screen[:, 1]), np.abs(screen[:, 2])) > 0.62]
    for points in (hole, hole[:0]):
        case.points = points.astype(np.float32)
        planner.reset()
        plan = case.plan(planner)
        expected, is_sure = stop_clearances(case, planner, plan)
        found = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0]
        assert (found[is_sure & (expected == 0.0)] < planner.config.stop_proof.stop_clearance).all()
        is_clear.append(int((found >= planner.config.stop_proof.stop_clearance).sum()))
    assert is_clear[0] < is_clear[1]


def closing_in(planner: Planner, *, period: float = 0.02, count: int = 6) -> tuple[list[Plan], list[Array]]:
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


def test_a_proven_stop_that_is_clear_of_static_obstacles_is_flown_whatever_moves(device: str):
    planner = Planner(config_of(sampling__dt=0.05), device=device)
    plans, _ = closing_in(planner)
    assert plans[0].status == PlanStatus.OK
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    assert plans[-1].moving is not None and len(plans[-1].moving.positions) == 20
    assert planner.history().arrays["proven_stop_age"][0] == pytest.approx(0.1)


@pytest.mark.parametrize(("period", "count"), [(0.02, 10), (0.049, 5), (0.05, 4)])
def test_a_proven_stop_is_flown_as_it_was_proven(device: str, period: float, count: int):
    """However often the planner plans meanwhile, the drone is where the stop leads; its time step is 0.05 s."""
    planner = Planner(config_of(sampling__dt=0.05), device=device)
    plans, flown = closing_in(planner, period=period, count=count)
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    fine = planner.config.replace({"sampling.dt": 0.005})
    stop = planner.history().arrays["proven_stop"][0].astype(np.float64)
    controls = np.repeat(stop, 10, axis=0)[: round(200 * period * count)]
    expected = reference.roll_out(flown[0], np.array([1.0, 0, 0, 0]), np.array([3.0, 0, 0]), controls, fine)
    np.testing.assert_allclose(flown[-1], expected.p[-1], atol=2e-3)
    for plan in plans:
        np.testing.assert_array_equal(plan.command, plan.controls[plan.best])


@functools.cache
def fallback_kernel(composition: Composition) -> Any:
    choose = fallback(composition)
    Views: Any = composition.Views
    AllScores: Any = Scores

    @wp.kernel(module="unique", enable_backward=False)
    def fallback_kernel(
        status: int, demanded: float, scores: AllScores, views: Views, params: wp.array(dtype=Params),
        out: wp.array(dtype=int),
    ):  # fmt: skip
        out[0] = choose(0, 1, status, demanded, scores, views, params[0])

    return fallback_kernel


@pytest.mark.parametrize(
    ("braking", "flown"),
    [
        ([(0.4, 0.4), (0.5, 0.5), (0.35, 0.35)], 6),  # the proven stop comes first
        ([(0.4, 0.4), (0.5, 0.5), (0.2, 0.2)], 2),  # the largest clearance
        ([(0.4, 0.4), (0.1, 0.5), (0.0, 0.35)], 1),  # it evades what moves, while the proven stop does not
        ([(0.2, 0.5), (0.1, 0.5), (0.0, 0.35)], 6),  # nothing evades what moves
        ([(0.25, 0.25), (0.1, 0.5), (0.0, 0.2)], 2),  # static obstacles count more
        ([(0.25, 0.25), (0.1, 0.2), (0.0, 0.2)], 1),
    ],
)
@pytest.mark.parametrize("status", [PlanStatus.NO_SAFE_CANDIDATE, PlanStatus.STALE_CLOUD])
def test_static_obstacles_decide_first_what_is_flown_instead(
    device: str, braking: list[tuple[float, float]], flown: int, status: PlanStatus
):
    """`braking` are the clearances of two braking candidates and the proven stop, from all and from static obstacles.

    With a cloud that is too old, the proven stop is not flown.
    """
    planner = Planner(config_of(), device=device)
    composition = Composition.of(planner.config)
    *fan, proven = braking
    rows = np.array([[(-1.0, -1.0), *fan, *[(-2.0, -2.0)] * (int(BRAKING_FAN) - 2), proven]])
    least = wp.array(rows, dtype=wp.vec2, device=device)
    start = wp.full((1, rows.shape[1], 1), 1.0, dtype=float, device=device)  # clearance at the start
    ready = wp.ones(1, dtype=int, device=device)
    views = composition.Views()
    views.stop_proof = bundle(StopProof, stop_ready=ready, least_clearance=least, static_clearance=start)
    out = wp.zeros(1, dtype=int, device=device)
    inputs = [
        int(status),
        0.3,
        bundle(Scores, least_clearance=least, static_clearance=start),
        views,
        planner.params,
        out,
    ]
    wp.launch(fallback_kernel(composition), 1, inputs=inputs, device=device)
    if flown == 6 and status == PlanStatus.STALE_CLOUD:
        flown = 2 if fan[1] > fan[0] else 1
    assert out.numpy()[0] == flown


def test_where_no_stop_is_clear_the_instance_with_the_widest_one_may_be_flown(device: str):
    """Without a safe candidate the drone brakes, or flies an instance whose stop is wider than every other one."""
    planner, kinds = Planner(config_of(), device=device), set()
    for seed in range(8):
        planner.reset()
        plan = random_case(seed, nearest=0.35).plan(planner)
        if plan.status == PlanStatus.NO_SAFE_CANDIDATE:
            kinds.add(plan.kinds[plan.best])
            widest = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0].reshape(-1, int(STOPS)).max(axis=1)
            assert widest.max() < planner.config.stop_proof.stop_clearance
            assert plan.kinds[plan.best] == "brake" or plan.best == widest.argmax()
    assert kinds == {"brake", "anchor"}
